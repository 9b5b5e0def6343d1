"""Render the object at t = 0 from cameras on a sphere."""

from pathlib import Path

from neuma_lib.config.settings import pick
from neuma_lib.data.blender.appearance import Appearance
from neuma_lib.data.blender.bodies import make_body
from neuma_lib.data.blender.scene import RenderSettings, render_static
from neuma_lib.geometry.shapes import place
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.splatting.viewpoints import static_views
from workflow.stage import stage


def main(particles_file: str, transforms: str, params, run) -> None:
    scene, images = params.scene, params.images
    arrays, _ = read_arrays(particles_file, only=("x", "tracers"), required=("x", "tracers"))
    mesh = place(scene["shape"], scene["size"], scene["height"], scene["center"])
    look = pick(Appearance, scene["appearance"])
    body = make_body(scene["appearance"]["kind"], mesh, look, arrays["x"][:1], arrays["tracers"][:1])
    views = static_views(body.points, images["views"], images["width"], images["height"])
    settings = RenderSettings(samples=images["samples"], threads=params.threads)
    render_static(body, views, Path(transforms).parent, settings, run.progress)
    run.say(f"{len(views)} views of {views.width}x{views.height} px")


if __name__ == "__main__":
    with stage(f"render_static {snakemake.wildcards.scene}", snakemake.log[0]) as run:
        main(snakemake.input.particles, snakemake.output.transforms, snakemake.params, run)
