"""The benchmark of random scenes of several bodies as a table."""

from neuma_lib.io.files import read_json, write_text
from neuma_lib.paper.piles_table import piles_table
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    scenes = [
        {**scene, **{name: [read_json(file) for file in own] for name, own in files.items()}}
        for scene, files in zip(params.scenes, params.files, strict=True)
    ]
    csv, markdown = piles_table(scenes, params.seed, params.development)
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)
    run.log(f"{len(scenes)} scenes: {output.markdown}")


run_script(main, snakemake)
