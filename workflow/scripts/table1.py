"""Table 1 of the paper from the metrics of its cells."""

from neuma_lib.evaluation.tables import chamfer_table
from neuma_lib.io import read_json, write_text
from neuma_lib.progress import stage


def main(metric_files: list[str], output, params, run) -> None:
    cells = iter(metric_files)
    metrics = {
        method: {scene: read_json(next(cells)) for scene in params.scenes} for method in params.methods
    }
    table = chamfer_table(metrics, params.methods, params.scenes)
    write_text(output.csv, table.csv())
    write_text(output.markdown, table.markdown())
    run.say(f"{len(params.methods)} methods on {len(params.scenes)} scenes: {output.markdown}")


if __name__ == "__main__":
    with stage("table1", snakemake.log[0]) as run:
        main(list(snakemake.input.metrics), snakemake.output, snakemake.params, run)
