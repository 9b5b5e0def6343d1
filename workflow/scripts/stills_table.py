"""Table of the stiffness of bodies at rest."""

from neuma_lib.io.files import read_json, write_text
from neuma_lib.paper.stills_table import stills_table
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    results = dict(zip(params.titles, map(read_json, inputs.results), strict=True))
    csv, markdown = stills_table(results)
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)
    run.log(f"{len(results)} bodies: {output.markdown}")


run_script(main, snakemake)
