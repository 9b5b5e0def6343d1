"""Take images that were made elsewhere, in our layout or in that of the authors' release."""

from neuma_lib.io.images import list_images
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    images = list_images(inputs.images, output.transforms)
    views = len(set(images.views.tolist()))
    run.say(
        f"{len(images.images)} images of {images.width}x{images.height} px, {views} views, from {inputs.images}"
    )


run_script(main, snakemake)
