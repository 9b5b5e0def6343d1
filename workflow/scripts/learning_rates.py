"""What each method reaches with each learning rate; the best is chosen by training loss, without ground truth."""

from neuma_lib.evaluation.reports import learning_rate_table
from neuma_lib.io.files import read_json, write_text
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    cells = zip(params.cells, inputs.histories, inputs.metrics, strict=True)
    rows = [{**read_json(history), **read_json(metrics), **cell} for cell, history, metrics in cells]
    csv, markdown, best = learning_rate_table(rows)
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)
    run.say("best: " + ", ".join(f"{method} x{scale:g}" for method, scale in best.items()))


run_script(main, snakemake)
