"""Render the object at t = 0 from cameras on a sphere."""

from pathlib import Path

from neuma_lib.config.blender import AppearanceConfig, ImagesConfig
from neuma_lib.data.blender.bodies import make_body
from neuma_lib.data.blender.scene import render_static
from neuma_lib.geometry.shapes import place
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.splatting.viewpoints import static_views
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    scene, images = params.scene, ImagesConfig(**params.images)
    arrays, _ = read_arrays(inputs.particles, only=("x", "tracers"), required=("x", "tracers"))
    mesh = place(scene["shape"], scene["size"], scene["height"], scene["center"])
    look = AppearanceConfig(**scene["appearance"])
    body = make_body(mesh, look, arrays["x"][:1], arrays["tracers"][:1])
    views = static_views(body.points, images.views, images.width, images.height)
    folder = Path(output.transforms).parent
    render_static(body, views, folder, images.samples, params.threads, run.progress, params.device)
    run.say(f"{len(views)} views of {views.width}x{views.height} px")


run_script(main, snakemake)
