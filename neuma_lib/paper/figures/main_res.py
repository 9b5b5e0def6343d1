"""Renders over time: the observation, the prior (NCLaw), NeuMA and its ablations, at the same times from the training
view. Renders have a higher resolution than the video; those of PAC-NeRF on its own particles are
of its radiance field. Paper: fig:main_res.
"""

import numpy as np
from matplotlib.figure import Figure

from neuma_lib.evaluation.plotting import rendering, style
from neuma_lib.io.particles import load_motion
from neuma_lib.methods.base import method_of
from neuma_lib.paper.image_grid import GAP, ImageGrid, draw_images, note

LEFT, TOP, BETWEEN = 0.92, 0.3, 0.06


def data(inputs, params, log) -> ImageGrid:
    """A row for the observation and each method. Numbers: ``groups``, (scene, number of its columns) in order."""
    blocks, times, groups = [], [], []
    rollouts = iter(inputs.rollouts)
    for k, (scene, setting) in enumerate(params.scenes.items()):
        video, body, cameras = rendering.film(inputs, params, k, setting["density"])
        picked = rendering.evenly(params.shown, len(video.frames))
        rows = [rendering.observed(video, picked, params.magnify)]
        for method in params.titles:
            states = (state[picked] for state in load_motion(next(rollouts)))
            own = params.own.get(method, {}).get(scene)
            seen = own_body(own, setting["density"]) if own else body
            rows.append(rendering.renders(seen, cameras, *states))
        blocks.append(np.stack(rows))
        times += rendering.milliseconds([video.frames[i] for i in picked], setting["dt"])
        groups.append((scene, len(picked)))
    images = np.concatenate(rendering.cropped(blocks), axis=1)
    log(f"{images.shape[0]} x {images.shape[1]} pictures")
    return ImageGrid(images, ("Observation", *params.titles.values()), tuple(times), {"groups": groups})


def own_body(source, density):
    """The body of particles that a method was fitted with."""
    method = method_of(source["module"])
    return method.load_reconstruction(
        source["files"], source["options"][0], density, source["particle_source"], "mean"
    )


@style.styled
def draw(grid: ImageGrid) -> Figure:
    """A block of columns for each scene."""
    groups = grid.numbers["groups"]
    width = (style.PAGE - LEFT - BETWEEN * (len(groups) - 1)) / len(grid.columns)
    height = grid.height(width, columns=1)
    figure = style.new_canvas(style.PAGE, TOP + len(grid.rows) * (height + GAP) + 0.03)
    left, first = LEFT, 0
    for scene, count in groups:
        part = slice(first, first + count)
        note(figure, left + count * width / 2, 0.09, scene, ha="center", fontweight="bold")
        rows = grid.rows if first == 0 else ()
        draw_images(figure, grid.images[:, part], left, TOP, count * width, rows, grid.columns[part])
        left, first = left + count * width + BETWEEN, first + count
    return figure
