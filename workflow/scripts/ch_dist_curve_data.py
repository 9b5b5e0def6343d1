"""Chamfer distances over time of all methods and scenes."""

from neuma_lib.io.files import read_json, write_json
from workflow.stage import stage


def main(metric_files: list[str], data_file: str, params, run) -> None:
    cells = iter(metric_files)
    metrics = {method: {scene: read_json(next(cells)) for scene in params.scenes} for method in params.titles}
    first = next(iter(params.titles))
    scenes = {
        scene: {
            "time": [dt * step for step in metrics[first][scene]["frames"]],
            "floor": metrics[first][scene]["chamfer_floor_per_frame"],
            "chamfer": {method: metrics[method][scene]["chamfer_per_frame"] for method in params.titles},
        }
        for scene, dt in params.scenes.items()
    }
    write_json(data_file, {"titles": params.titles, "scenes": scenes})
    run.say(f"{len(params.titles)} methods on {len(scenes)} scenes: {data_file}")


if __name__ == "__main__":
    with stage("ch_dist_curve_data", snakemake.log[0]) as run:
        main(list(snakemake.input.metrics), snakemake.output.data, snakemake.params, run)
