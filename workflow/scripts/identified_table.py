"""Identified materials next to the true ones, as a table."""

from neuma_lib.io.files import read_json, write_text
from neuma_lib.paper.identified_table import identified_table
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    scenes = [
        {**entry, "identified": read_json(file)}
        for entry, file in zip(params.scenes, inputs.identified, strict=True)
    ]
    csv, markdown = identified_table(scenes)
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)


run_script(main, snakemake)
