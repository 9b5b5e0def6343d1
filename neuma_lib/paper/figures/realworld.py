"""Filmed objects, segmented in their videos, and predictions of Spring-Gaus and NeuMA from the first frame, in the same
camera. Right: PSNR and LPIPS (VGG) of the object, means over all cameras and measured frames. Paper:
fig:realworld.
"""

import numpy as np
import torch
from matplotlib.figure import Figure

from neuma_lib.coupling.filmed import Filmed
from neuma_lib.evaluation.plotting import rendering, style
from neuma_lib.io.files import read_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import load_videos
from neuma_lib.io.particles import load_motion, load_reconstruction
from neuma_lib.paper.image_grid import GAP, ImageGrid, draw_images, note

LEFT, TOP, UNDER = 0.92, 0.3, 0.12


def data(inputs, params, log) -> ImageGrid:
    """Blocks of rows are takes: the video, then each method. Columns are times.

    Numbers: ``scenes``; ``measures``, for each scene and method PSNR [dB] and LPIPS.
    """
    blocks, times, measures = [], [], []
    rollouts, files_of_measures = iter(inputs.rollouts), iter(inputs.measures)
    for k, setting in enumerate(params.scenes.values()):
        (video,) = load_videos(inputs.shown[k], [params.view], **setting["exposure"])
        files = (inputs.particles[k], inputs.binding[k], inputs.gaussians[k])
        picked = rendering.evenly(params.frames, len(video.frames))
        seen = video.select(picked)
        rows = [rendering.as_bytes(seen.colours()[:, 0])]
        measures.append([])
        for method in params.titles:
            body = load_reconstruction(*files, rendering.DENSITY, gaussian_motion=setting["motion"][method])
            rollout = next(rollouts)
            steps = read_arrays(rollout, required=("frames",), only=("frames",))[0]["frames"].tolist()
            renders = Filmed(body.particle_gs(video.cameras), seen, steps)
            x, F = (renders.states(state.to(body.x0)) for state in load_motion(rollout))
            with torch.no_grad():
                rows.append(rendering.as_bytes(renders(x, F)[:, 0]))
            means = [read_json(next(files_of_measures))["mean"] for _ in range(setting["cameras"])]
            measures[-1].append([float(np.mean([m[key] for m in means])) for key in ("psnr", "lpips_vgg")])
        blocks.append(np.stack(rows))
        times.append(rendering.milliseconds(seen.frames, setting["dt"]))
    count = min(block.shape[1] for block in blocks)
    images = np.concatenate([block[:, :count] for block in rendering.cropped(blocks)])
    log(f"{len(blocks)} takes, {images.shape[0]} x {count} pictures")
    titles = [title for _ in blocks for title in ("video", *params.titles.values())]
    numbers = {"scenes": list(params.scenes), "measures": measures, "times": [t[:count] for t in times]}
    return ImageGrid(images, tuple(titles), tuple(str(k) for k in range(count)), numbers)


@style.styled
def draw(grid: ImageGrid) -> Figure:
    """A block for each take, with times above and measures next to its rows."""
    numbers, right = grid.numbers, 0.95
    width = style.PAGE - LEFT - right
    height = grid.height(width)
    rows = len(grid.rows) // len(numbers["scenes"])
    block = TOP + rows * (height + GAP) + UNDER
    figure = style.new_canvas(style.PAGE, block * len(numbers["scenes"]) + 0.03)
    for k, scene in enumerate(numbers["scenes"]):
        part, top = slice(k * rows, (k + 1) * rows), k * block + TOP
        note(figure, LEFT + width / 2, top - TOP + 0.09, scene, ha="center", fontweight="bold")
        draw_images(figure, grid.images[part], LEFT, top, width, grid.rows[part], tuple(numbers["times"][k]))
        for row, (psnr, lpips) in enumerate(numbers["measures"][k], 1):
            at = top + (row + 0.5) * (height + GAP)
            note(figure, LEFT + width + 0.06, at, f"{psnr:.1f} dB / {lpips:.3f}", ha="left")
    return figure
