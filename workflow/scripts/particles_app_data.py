"""Particles of the truth and of all methods at the same times."""

import numpy as np

from neuma_lib.evaluation.figures.panels import Panels, save_panels
from neuma_lib.evaluation.figures.pictures import (
    cropped,
    evenly,
    frontal,
    milliseconds,
    particle_pictures,
    sphere_radius,
)
from neuma_lib.evaluation.figures.style import TRUE_PARTICLES, look
from neuma_lib.io.hdf5 import read_arrays
from workflow.stage import stage


def main(inputs, data_file: str, params, run) -> None:
    truth, _ = read_arrays(inputs.truth, required=("x", "vol0"), only=("x", "vol0", "frames"))
    bound, _ = read_arrays(inputs.binding, only=("vol0",))
    shown = evenly(params.shown, len(truth["x"]))
    paths = {"truth": truth["x"][shown]}
    for method, file in zip(params.titles, inputs.rollouts, strict=True):
        paths[method] = read_arrays(file, required=("x",), only=("x",))[0]["x"][shown]
    cameras = frontal(np.concatenate([x.reshape(-1, 3) for x in paths.values()]), params.size, params.size)
    rows = [
        particle_pictures(
            x,
            TRUE_PARTICLES if method == "truth" else look(method).color,
            sphere_radius(truth["vol0"] if method == "truth" else bound["vol0"]),
            cameras,
        )
        for method, x in paths.items()
    ]
    (images,) = cropped([np.stack(rows)])
    columns = tuple(milliseconds(truth["frames"][shown], params.dt))
    save_panels(data_file, Panels(images, ("Truth", *params.titles.values()), columns))
    run.say(f"{images.shape[0]} x {images.shape[1]} pictures: {data_file}")


if __name__ == "__main__":
    with stage("particles_app_data", snakemake.log[0]) as run:
        main(snakemake.input, snakemake.output.data, snakemake.params, run)
