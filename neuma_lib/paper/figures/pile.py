"""A pile of several bodies, filmed by one camera, understood (the laws and the friction that were identified in the
video), and played on with one body taken out: by the identified and by the true laws. Not in the paper.
"""

import numpy as np
from matplotlib.figure import Figure

from neuma_lib.evaluation.plotting import rendering, style
from neuma_lib.io.images import load_observation
from neuma_lib.io.particles import load_motion
from neuma_lib.paper.image_grid import ImageGrid, rows_figure

LEFT, TOP = 0.9, 0.2


def data(inputs, params, log) -> ImageGrid:
    """A row for the video and for each prediction, with a column for each time."""
    video = load_observation(inputs.transforms, [params.view])
    bodies = rendering.bodies(inputs, gaussian_motion="affine")
    picked = rendering.evenly(params.shown, len(video.frames))
    steps = [video.frames[k] for k in picked]
    cameras = rendering.magnified(video.cameras, params.magnify)
    rows = [rendering.observed(video, picked, params.magnify)]
    for rollout, k in zip(inputs.rollouts, params.body_of, strict=True):
        motion = load_motion(rollout)
        at = [params.frames[k].index(step) for step in steps]
        rows.append(rendering.renders(bodies[k], cameras, *(state[at] for state in motion)))
    columns = rendering.milliseconds(np.asarray(steps), params.dt)
    log(f"{len(rows)} rows at {', '.join(columns)}")
    (cut,) = rendering.cropped([np.concatenate(rows)])
    return ImageGrid(cut.reshape(len(rows), -1, *cut.shape[1:]), tuple(params.titles), tuple(columns))


@style.styled
def draw(grid: ImageGrid) -> Figure:
    """The rows below each other, times above."""
    return rows_figure(grid, LEFT, TOP, grid.rows)
