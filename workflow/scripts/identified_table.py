"""Identified materials next to the true ones, as a table."""

from neuma_lib.io.files import read_json, write_text
from neuma_lib.paper.identified_table import IdentifiedScene, identified_table
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    scenes = [
        IdentifiedScene(entry["name"], entry["group"], read_json(file), entry["truth"])
        for entry, file in zip(params.scenes, inputs.identified, strict=True)
    ]
    csv, markdown = identified_table(scenes)
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)


run_script(main, snakemake)
