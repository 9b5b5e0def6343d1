"""Simulate the true material of a benchmark."""

import numpy as np

from neuma_lib.dataset import simulate_ground_truth
from neuma_lib.geometry.shapes import place
from neuma_lib.io import write_arrays
from neuma_lib.materials import analytic_law
from neuma_lib.progress import stage
from neuma_lib.sim import MPMModel


def main(output, params, run) -> None:
    scene, model = params.scene, MPMModel(**params.simulation)
    law = analytic_law(scene["law"], dt=model.dt)
    mesh = place(scene["shape"], scene["size"], scene["height"], scene["center"])
    truth = simulate_ground_truth(
        model,
        law,
        mesh,
        scene["velocity"],
        scene["density"],
        params.frames,
        particles=params.particles,
        tracers=params.tracers,
        seed=params.seed,
    )
    arrays = {name: getattr(truth.path, name).numpy() for name in ("x", "v", "F")}
    count = arrays["x"].shape[1]
    arrays |= {
        "frames": np.asarray(truth.frames),
        "time": np.asarray(truth.frames) * model.dt,
        "vol0": np.full(count, truth.vol0, dtype=np.float32),
        "mass": np.full(count, truth.mass, dtype=np.float32),
        "tracers": truth.tracers.numpy(),
        "tracers_again": truth.tracers_again.numpy(),
    }
    write_arrays(output.particles, arrays, {"dt": model.dt, "scene": scene, "simulation": params.simulation})
    lowest = float(arrays["x"][..., 1].min())
    run.say(
        f"{count} particles, {truth.frames[-1]} steps, {len(truth.frames)} frames, lowest point {lowest:.3f} m"
    )


if __name__ == "__main__":
    with stage(f"ground_truth {snakemake.wildcards.scene}", snakemake.log[0]) as run:
        main(snakemake.output, snakemake.params, run)
