"""Coverage of intervals and probabilities over scenes, as a table."""

from neuma_lib.io.files import read_json, write_text
from neuma_lib.paper.calibration_table import calibration_table
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    scenes = list(map(read_json, inputs.records))
    csv, markdown = calibration_table(scenes, params.development, params.determined)
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)
    run.log(f"{len(inputs.records)} scenes")


run_script(main, snakemake)
