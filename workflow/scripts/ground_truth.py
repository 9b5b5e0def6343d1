"""Simulate the true materials of a benchmark or an experiment."""

from dataclasses import replace

import numpy as np

from neuma_lib.data.ground_truth import TrueBody, change_by_a_doubled_grid, simulate_ground_truth
from neuma_lib.device import choose_device
from neuma_lib.geometry.shapes import place
from neuma_lib.io.files import listed
from neuma_lib.io.hdf5 import write_arrays
from neuma_lib.io.simulator import simulator
from neuma_lib.mechanics.analytic import analytic_law
from workflow.inputs import solid
from workflow.stage import run_script


def simulated(model, inputs, params):
    """The truth at a resolution. A body of a converged truth has as many particles as the grid needs."""
    meshes = iter(listed(inputs.meshes))
    bodies = [
        TrueBody(
            place(
                solid(body["shape"], meshes),
                body["size"],
                body["height"],
                body["center"],
                rotation=body["rotation"],
            ),
            analytic_law(body["law"], dt=model.dt),
            body["velocity"],
            body["density"],
            body["spin"],
        )
        for body in params.bodies
    ]
    substeps = round(params.dt / model.dt)  # frames are counted in steps of the reconstruction
    return simulate_ground_truth(
        model,
        bodies,
        [substeps * n for n in params.frames],
        particles=params.particles,
        tracers=params.tracers,
        seed=params.seed,
        stored=params.stored,
        separate=params.separate,
        device=choose_device(params.device),
    )


def main(inputs, output, params, run) -> None:
    model = simulator(params.simulation)
    converged = params.particles is None
    truth = simulated(model, inputs, params)
    change = (
        change_by_a_doubled_grid(
            truth, simulated(replace(model, grid=model.grid // 2, dt=2 * model.dt), inputs, params)
        )
        if converged
        else None
    )
    arrays = {name: getattr(truth.path, name).numpy() for name in ("x", "v", "F")}
    arrays |= {
        "frames": np.asarray(params.frames),
        "time": np.asarray(params.frames) * params.dt,
        **{name: getattr(truth, name).numpy() for name in ("vol0", "mass", "tracers", "tracers_again")},
    }
    if params.separate:
        arrays |= {"body": truth.body.numpy(), "tracer_body": truth.tracer_body.numpy()}
    write_arrays(
        output.truth,
        arrays,
        {
            "dt": params.dt,
            "bodies": params.bodies,
            "simulation": params.simulation,
            **({"change_by_a_doubled_grid": change} if converged else {}),
        },
    )
    count, lowest = arrays["x"].shape[1], float(arrays["x"][..., 1].min())
    run.log(
        f"{count} particles, {truth.frames[-1]} steps, {len(truth.frames)} frames, lowest point {lowest:.3f} m"
        + (f", a doubled grid would change tracers by about {1e3 * change:.1f} mm" if converged else "")
    )


run_script(main, snakemake)
