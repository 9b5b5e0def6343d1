"""Letters and meetings of several objects under trained materials."""

import numpy as np
import torch

from neuma_lib.evaluation.figures.panels import Panels, save_panels
from neuma_lib.evaluation.figures.pictures import evenly, frontal, milliseconds, renders
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.particles import load_body
from workflow.stage import stage

UNIT = 1000.0
"""Densities do not show in pictures."""


def main(inputs, data_file: str, params, run) -> None:
    paths = [read_arrays(file, required=("x", "F", "frames")) for file in inputs.rollouts]
    bodies = [load_body(*files, UNIT) for files in zip(inputs.binding, inputs.gaussians, strict=True)]
    letters, count = len(params.letters), len(params.letters) or params.shown
    points = np.concatenate([arrays["x"].reshape(-1, 3) for arrays, _ in paths[:letters] or paths])
    wide, high = np.ptp(points, axis=0)[:2]
    width, height = params.size, round(params.size * float(np.clip(high / wide, 0.6, 1.5)))

    def filmed(k: int, cameras, shown) -> np.ndarray:
        arrays, _ = paths[k]
        return renders(bodies[k], cameras, *(torch.from_numpy(arrays[name][shown]) for name in ("x", "F")))

    rows, titles, times = [], [], []
    if letters:
        steps = [len(arrays["x"]) for arrays, _ in paths[:letters]]
        cameras = frontal(points, width, height)
        columns = [filmed(k, cameras, evenly(params.shown, steps[k])) for k in range(letters)]
        rows += list(np.stack(columns, axis=1))
        last = min(len(column) for column in columns) - 1
        titles += [f"{100 * i / last:.0f} % of\nthe sequence" for i in range(last + 1)]
    split = len(rows)
    for k, title in enumerate(params.others.values(), start=letters):
        arrays, attributes = paths[k]
        shown = evenly(count, len(arrays["x"]))
        rows.append(filmed(k, frontal(arrays["x"], width, height), shown))
        titles.append(title)
        times.append(milliseconds(arrays["frames"][shown], attributes["dt"]))
    numbers = {
        "letters": split,
        "materials": [entry["material"] for entry in params.letters],
        "times": times[0] if times else [],
    }
    columns = [entry["letter"] for entry in params.letters] or times[0]
    save_panels(data_file, Panels(np.stack(rows), tuple(titles), tuple(columns), numbers))
    run.say(f"{letters} letters, {len(params.others)} scenes of several bodies: {data_file}")


if __name__ == "__main__":
    with stage("vis_generalize_data", snakemake.log[0]) as run:
        main(snakemake.input, snakemake.output.data, snakemake.params, run)
