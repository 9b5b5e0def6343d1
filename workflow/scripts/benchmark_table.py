"""Table 4 of the paper from the settings of the scenes."""

from neuma_lib.io.files import write_text
from neuma_lib.paper.reports import benchmark_table
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    csv, markdown = benchmark_table(params.scenes)
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)
    run.log(f"{len(params.scenes)} benchmarks: {output.markdown}")


run_script(main, snakemake)
