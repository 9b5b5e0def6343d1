"""Film the moving object from a ring of cameras."""

from pathlib import Path

from neuma_lib.config.blender import AppearanceConfig, ImagesConfig
from neuma_lib.data.blender.bodies import make_body
from neuma_lib.data.blender.scene import render_dynamic
from neuma_lib.geometry.shapes import place
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.splatting.viewpoints import video_views
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    scene, images = params.scene, ImagesConfig(**params.images)
    names = ("x", "tracers", "frames")
    arrays, attributes = read_arrays(inputs.particles, only=names, required=names)
    mesh = place(scene["shape"], scene["size"], scene["height"], scene["center"])
    look = AppearanceConfig(**scene["appearance"])
    body = make_body(mesh, look, arrays["x"], arrays["tracers"])
    views = video_views(body.points, images.views, images.width, images.height)
    steps = arrays["frames"].tolist()
    folder = Path(output.transforms).parent
    how = (images.samples, params.threads, run.progress, params.device)
    render_dynamic(body, views, steps, attributes["dt"], folder, *how)
    run.say(f"{len(views)} views, {len(steps)} frames of {views.width}x{views.height} px")


run_script(main, snakemake)
