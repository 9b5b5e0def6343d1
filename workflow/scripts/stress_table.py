"""A table of stress errors."""

from neuma_lib.evaluation.paper import PAPER
from neuma_lib.evaluation.stress_table import stress_table
from neuma_lib.io.files import read_json, write_text
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    errors: dict[str, dict[str, list]] = {}
    for (method, column), file in zip(params.cells, list(inputs.stress), strict=True):
        errors.setdefault(method, {}).setdefault(column, []).append(read_json(file))
    csv, markdown, verdicts = stress_table(errors, params.titles, params.columns, PAPER["stress"])
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)
    run.say(f"{len(params.titles)} methods, {len(params.columns)} columns: {output.markdown}")
    for verdict in verdicts:
        run.say(str(verdict))


run_script(main, snakemake)
