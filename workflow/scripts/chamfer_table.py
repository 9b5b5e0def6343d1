"""A table of tracer errors and Chamfer distances from the metrics behind it."""

from neuma_lib.io.files import read_json, write_text
from neuma_lib.paper.published import PAPER
from neuma_lib.paper.tables import chamfer_table
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    metrics: dict[str, dict[str, list]] = {}
    for (method, column), file in zip(params.cells, list(inputs.metrics), strict=True):
        metrics.setdefault(method, {}).setdefault(column, []).append(read_json(file))
    table = chamfer_table(
        metrics, params.titles, params.columns, PAPER.get(params.name), params.notes, params.note
    )
    write_text(output.csv, table.csv())
    write_text(output.markdown, table.markdown())
    run.log(f"{len(params.titles)} methods, {len(params.columns)} columns: {output.markdown}")
    for verdict in table.verdicts():
        run.log(str(verdict))


run_script(main, snakemake)
