"""Adaptor with weight w, from the prior (w = 0; for a structured law, its constants) to the trained law (w = 1) and
slightly beyond (dashed). Left: renders. Right: mean height of the body over time, with the truth as dots. A motion that
becomes non-finite, which can happen beyond 1, is held at its last finite frame. Paper: fig:lora_alphav.
"""

from collections.abc import Sequence

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure

from neuma_lib.device import choose_device
from neuma_lib.evaluation.metrics import mean_height
from neuma_lib.evaluation.plotting import rendering, style
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.laws import load_law
from neuma_lib.io.particles import with_motion
from neuma_lib.io.simulator import simulator
from neuma_lib.paper.image_grid import GAP, ImageGrid, draw_images, note, place
from neuma_lib.sim.prediction import predict

LEFT, LEGEND, TITLE, PICTURES, CURVES, BETWEEN = 0.5, 0.2, 0.34, 4.0, 1.85, 0.38
APART = 0.002  # minimum difference of heights that counts [m]. Before contact, all motions are equal.


def data(inputs, params, log) -> ImageGrid:
    """Rows are times, scene by scene. Columns are the weights and the observation.

    Numbers: ``weights`` and ``scenes`` {scene: {rows, time [s], heights [m] of each weight, truth [m]}}.
    """
    device = choose_device(params.device)
    blocks, rows, scenes = [], [], {}
    inside = [k for k, weight in enumerate(params.weights) if 0 <= weight <= 1]
    for k, (scene, setting) in enumerate(params.scenes.items()):
        model = simulator(setting["simulation"])
        video, body, cameras = rendering.film(inputs, params, k, setting["density"])
        body, cameras = body.to(torch.float32, device), cameras.to(device)
        law = load_law(inputs.prior[k] if inputs.prior else None, inputs.adaptor[k], model.dt).to(device)
        start = with_motion(body, inputs.start[k])
        truth, _ = read_arrays(inputs.truth[k], required=("x", "mass"), only=("x", "mass"))
        picked = rendering.evenly(params.shown, len(video.frames))[1:]  # the start is the same for all
        columns, heights = [], []
        for weight in params.weights:
            law.set_adaptor_weight(weight)
            path, failure = predict(model, law, start, video.frames, total=params.total[scene])
            columns.append(rendering.renders(body, cameras, path.x[picked], path.stretch[picked]))
            heights.append(mean_height(path.x.cpu(), body.mass.cpu()))
            if failure:
                log(f"{scene}: w = {weight:g}: a particle {failure.happened} at step {failure.step}")
        monotone, parted = monotone_frames([heights[k] for k in inside])
        log(f"{scene}: between 0 and 1, height monotone in w in {monotone} of {parted} frames after contact")
        columns.append(rendering.observed(video, picked, params.magnify))
        blocks.append(np.stack(columns, axis=1))
        rows += rendering.milliseconds([video.frames[i] for i in picked], model.dt)
        scenes[scene] = {
            "rows": len(picked),
            "time": [model.dt * step for step in video.frames],
            "heights": heights,
            "truth": mean_height(truth["x"], truth["mass"]),
        }
    titles = [f"$w$ = {weight:g}" for weight in params.weights] + ["observed"]
    numbers = {"weights": params.weights, "scenes": scenes}
    images = np.concatenate(rendering.cropped(blocks, guides=[block[:, [*inside, -1]] for block in blocks]))
    return ImageGrid(images, tuple(rows), tuple(titles), numbers)


def monotone_frames(heights: Sequence[Sequence[float]]) -> tuple[int, int]:
    """Number of frames in which heights (W, T) [m] are monotone in the weight, and number of frames that count.

    Frames count if their heights differ by more than `APART`.
    """
    steps = np.diff(heights, axis=0)
    parted = np.ptp(heights, axis=0) > APART
    monotone = (steps >= 0).all(axis=0) | (steps <= 0).all(axis=0)
    return int((monotone & parted).sum()), int(parted.sum())


@style.styled
def draw(grid: ImageGrid) -> Figure:
    """For each scene, a column for each weight, a row for each time, and the mean heights at the right."""
    numbers = grid.numbers
    heights = [scene["rows"] * (grid.height(PICTURES) + GAP) for scene in numbers["scenes"].values()]
    blocks = [max(h, 1.3) + TITLE + BETWEEN for h in heights]
    figure = style.new_canvas(style.PAGE, LEGEND + sum(blocks) + 0.03)
    weights = numbers["weights"]
    colors = matplotlib.colormaps[style.RAMP](np.linspace(0, 0.92, len(weights)))
    top, first = LEGEND, 0
    for (name, scene), block in zip(numbers["scenes"].items(), blocks):
        part = slice(first, first + scene["rows"])
        note(figure, LEFT, top + 0.09, name, fontweight="bold")
        draw_images(figure, grid.images[part], LEFT, top + TITLE, PICTURES, grid.rows[part], grid.columns)
        left = LEFT + PICTURES + 0.42
        axes = place(figure, left, top + 0.08, CURVES, block - 0.08 - BETWEEN)
        time = 1e3 * np.asarray(scene["time"])
        axes.plot(time, scene["truth"], "o", markersize=2.2, color=style.BLACK, label="truth")
        for weight, color, values in zip(weights, colors, scene["heights"]):
            dash = "-" if 0 <= weight <= 1 else (0, (2, 1))
            axes.plot(time, values, color=color, linestyle=dash, label=f"$w$ = {weight:g}")
        axes.set(xlabel="time [ms]", ylabel="mean height [m]", xlim=(0, time[-1]))
        axes.grid(axis="y")
        if first == 0:
            spacing = {"columnspacing": 1.2, "handlelength": 1.6, "borderaxespad": 0.1}
            entries = axes.get_legend_handles_labels()
            figure.legend(*entries, loc="upper center", ncols=len(weights) + 1, **spacing)
        top, first = top + block, first + scene["rows"]
    return figure
