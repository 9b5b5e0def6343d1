"""A prediction that goes on after the video ends."""

import numpy as np
import torch

from neuma_lib.evaluation.figures.panels import Panels, save_panels
from neuma_lib.evaluation.figures.pictures import (
    cropped,
    evenly,
    frontal,
    mean_height,
    milliseconds,
    particle_pictures,
    renders,
    sphere_radius,
)
from neuma_lib.evaluation.figures.style import TRUE_PARTICLES
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.particles import load_body
from workflow.stage import stage


def main(inputs, data_file: str, params, run) -> None:
    truth, attributes = read_arrays(
        inputs.truth, required=("x", "mass", "vol0", "frames"), only=("x", "mass", "vol0", "frames")
    )
    body = load_body(inputs.binding, inputs.gaussians, params.density)
    shown = evenly(params.shown, len(truth["frames"]))
    paths = [read_arrays(file, required=("x", "F"))[0] for file in inputs.rollouts]
    everywhere = [arrays["x"].reshape(-1, 3) for arrays in (truth, *paths)]
    cameras = frontal(np.concatenate(everywhere), params.size, params.size)
    rows = [particle_pictures(truth["x"][shown], TRUE_PARTICLES, sphere_radius(truth["vol0"]), cameras)]
    heights = {"truth": mean_height(truth["x"], truth["mass"])}
    for method, arrays in zip(params.titles, paths, strict=True):
        rows.append(renders(body, cameras, *(torch.from_numpy(arrays[name][shown]) for name in ("x", "F"))))
        heights[method] = mean_height(arrays["x"], body.mass)
    dt = attributes["dt"]
    numbers = {
        "observed": params.observed,
        "time": [dt * int(step) for step in truth["frames"]],
        "titles": {"truth": "Truth", **params.titles},
        "heights": heights,
    }
    (images,) = cropped([np.stack(rows)])
    columns = tuple(milliseconds(truth["frames"][shown], dt))
    save_panels(data_file, Panels(images, ("Truth (particles)", *params.titles.values()), columns, numbers))
    far = max(abs(a - b) for a, b in zip(heights["truth"], heights["neuma"], strict=True))
    run.say(f"mean height within {1e3 * far:.1f} mm of the truth: {data_file}")


if __name__ == "__main__":
    with stage("ext_time_data", snakemake.log[0]) as run:
        main(snakemake.input, snakemake.output.data, snakemake.params, run)
