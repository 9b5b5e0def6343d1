"""Take images that were made elsewhere, in our layout or in that of the authors' release."""

from neuma_lib.io.images import list_images
from workflow.stage import stage


def main(source: str, transforms: str, run) -> None:
    images = list_images(source, transforms)
    views = len(set(images.views.tolist()))
    run.say(f"{len(images.names)} images of {images.width}x{images.height} px, {views} views, from {source}")


if __name__ == "__main__":
    with stage(f"{snakemake.rule} {snakemake.wildcards.scene}", snakemake.log[0]) as run:
        main(snakemake.input.images, snakemake.output.transforms, run)
