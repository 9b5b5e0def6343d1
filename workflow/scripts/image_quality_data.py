"""Image metrics of all methods and scenes."""

from neuma_lib.evaluation.figures.image_quality import MEASURES
from neuma_lib.io.files import read_json, write_json
from workflow.stage import stage


def main(metric_files: list[str], data_file: str, params, run) -> None:
    cells = iter(metric_files)
    metrics = {method: {scene: read_json(next(cells)) for scene in params.scenes} for method in params.titles}
    values = {
        measure: {
            method: {scene: cell[measure] for scene, cell in row.items()} for method, row in metrics.items()
        }
        for measure in MEASURES
    }
    write_json(data_file, {"titles": params.titles, "scenes": params.scenes, **values})
    run.say(f"{len(params.titles)} methods on {len(params.scenes)} scenes: {data_file}")


if __name__ == "__main__":
    with stage("image_quality_data", snakemake.log[0]) as run:
        main(list(snakemake.input.metrics), snakemake.output.data, snakemake.params, run)
