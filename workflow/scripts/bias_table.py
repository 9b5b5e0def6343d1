"""A table of pixel losses beside those of the true law."""

from neuma_lib.evaluation.bias import bias_table
from neuma_lib.io.files import read_json, write_text
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    cells = zip(params.cells, inputs.bias, inputs.metrics, strict=True)
    rows = [{**read_json(metrics), **read_json(bias), **cell} for cell, bias, metrics in cells]
    csv, markdown, sentence = bias_table(rows, params.titles)
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)
    run.say(sentence or f"{len(rows)} runs: {output.markdown}")


run_script(main, snakemake)
