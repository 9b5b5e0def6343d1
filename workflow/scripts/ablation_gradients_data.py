"""What choices in gradient and covariance lead to."""

from neuma_lib.io.files import read_json, write_json
from workflow.stage import stage


def main(inputs, data_file: str, params, run) -> None:
    data = {"scenes": params.scenes, "titles": params.titles}
    names = ("loss", "chamfer_excess", "tracer_rmse_mm", "psnr")
    data |= {name: {variant: {} for variant in params.titles} for name in names}
    cells = zip(inputs.histories, inputs.metrics, inputs.image_metrics, strict=True)
    for variant in params.titles:
        for scene in params.scenes:
            history, metrics, images = map(read_json, next(cells))
            data["loss"][variant][scene] = history["best_loss"] / history["loss"][0]
            for name in ("chamfer_excess", "tracer_rmse_mm"):
                data[name][variant][scene] = metrics[name]
            data["psnr"][variant][scene] = images["psnr"]
    write_json(data_file, data)
    run.say(f"{len(params.titles)} variants on {len(params.scenes)} scenes: {data_file}")


if __name__ == "__main__":
    with stage("ablation_gradients_data", snakemake.log[0]) as run:
        main(snakemake.input, snakemake.output.data, snakemake.params, run)
