"""Render the object: at t = 0 from cameras on a sphere, or in motion from a ring of cameras."""

from dataclasses import replace
from pathlib import Path

from neuma_lib.config.blender import AppearanceConfig, ImagesConfig
from neuma_lib.data.blender.bodies import make_body
from neuma_lib.data.blender.scene import Several, render_dynamic, render_static
from neuma_lib.errors import InputError
from neuma_lib.geometry.obstacles import obstacles, sees_all
from neuma_lib.geometry.shapes import place
from neuma_lib.io.files import listed, parse_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.simulator import with_obstacles
from neuma_lib.splatting.viewpoints import static_views, video_views
from workflow.inputs import solid
from workflow.stage import run_script

MIN_VIEWS = 8  # least number of views at t = 0 that see all of the body


def main(inputs, output, params, run) -> None:
    images, owners = ImagesConfig(**params.images), ("body", "tracer_body")
    names = ("x", "tracers", "frames")
    arrays, attributes = read_arrays(inputs.truth, only=(*names, *owners), required=names)
    steps, meshes = arrays["frames"].tolist() if params.moving else [0], iter(listed(inputs.meshes))
    made = []
    for k, own in enumerate(params.bodies):
        mesh = place(
            solid(own["shape"], meshes), own["size"], own["height"], own["center"], rotation=own["rotation"]
        )
        points = [arrays[name][: len(steps)] for name in ("x", "tracers")]
        if len(params.bodies) > 1:
            points = [values[:, arrays[owner] == k] for values, owner in zip(points, owners, strict=True)]
        made.append(make_body(mesh, AppearanceConfig(**own["appearance"]), *points))
    body = made[0] if len(made) == 1 else Several(made)
    viewpoints = video_views if params.moving else static_views
    views = viewpoints(body.points, images.views, images.width, images.height)
    folder = Path(output.transforms).parent
    simulation = with_obstacles(parse_json(attributes.get("simulation", "{}"), inputs.truth))
    times = [step * attributes["dt"] for step in steps]
    colliders = simulation.get("colliders", ())
    around = obstacles(colliders, times)
    if colliders and not params.moving:  # a hull of masks would lose what an obstacle hides in a view
        whole = sees_all(colliders, views.c2w[:, :3, 3], body.points)
        if whole.sum() < MIN_VIEWS:
            problem = f"hide a part of the body in all but {whole.sum()} of {len(views)} views at t = 0"
            raise InputError(
                "colliders", problem, f"Move them. At least {MIN_VIEWS} views must see all of it"
            )
        views = replace(views, c2w=views.c2w[whole])
    how = {"threads": params.threads, "progress": run.progress, "device": params.device, "obstacles": around}
    if params.moving:
        render_dynamic(body, views, steps, attributes["dt"], folder, images.samples, **how)
    else:
        render_static(body, views, folder, images.samples, **how)
    run.log(f"{len(views)} views, {len(steps)} frames of {views.width}x{views.height} px")


run_script(main, snakemake)
