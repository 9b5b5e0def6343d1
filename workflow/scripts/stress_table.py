"""A table of stress errors."""

from neuma_lib.io.files import read_json, write_text
from neuma_lib.paper.published import PAPER
from neuma_lib.paper.stress_table import stress_table
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    results: dict[str, dict[str, dict[str, list]]] = {}
    for kind in ("stress", "responses"):
        for (method, column), file in zip(params.cells, list(inputs[kind]), strict=True):
            runs = results.setdefault(kind, {}).setdefault(method, {}).setdefault(column, [])
            runs.append(read_json(file))
    csv, markdown, verdicts = stress_table(
        results["stress"], params.titles, params.columns, PAPER["stress"], results["responses"]
    )
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)
    run.log(f"{len(params.titles)} methods, {len(params.columns)} columns: {output.markdown}")
    for verdict in verdicts:
        run.log(str(verdict))


run_script(main, snakemake)
