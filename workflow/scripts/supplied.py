"""Take images that were made elsewhere, in our layout or in one that other systems' authors use."""

from pathlib import Path

from neuma_lib.io.datasets.layouts import OFFSETS, take_video
from neuma_lib.io.images import list_images
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    world = {key: params.images[key] for key in ("scale", "offset")}
    source = f"from {inputs.images}"
    if Path(inputs.images).name in OFFSETS:
        stride = params.images["stride"]
        images = take_video(inputs.images, output.transforms, params.steps, stride, **world)
        source += f", a frame every {stride * params.dt:.6g} s"
    else:
        images = list_images(inputs.images, output.transforms, **world)
    views = len(set(images.views.tolist()))
    run.log(f"{len(images.images)} images of {images.width}x{images.height} px, {views} views, {source}")


run_script(main, snakemake)
