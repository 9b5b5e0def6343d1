"""Simulate the true law on the reconstruction, and keep states that it went through."""

from neuma_lib.device import choose_device
from neuma_lib.evaluation.stress import visit
from neuma_lib.io.hdf5 import write_arrays
from neuma_lib.io.particles import load_initial_state
from neuma_lib.io.simulator import simulator
from neuma_lib.mechanics.analytic import analytic_law
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    device = choose_device(params.device)
    files = [inputs[name] for name in ("particles", "binding", "gaussians", "velocity")]
    start, _ = load_initial_state(*files, [params.density])
    dt = params.simulation["dt"]
    law = analytic_law(params.law, dt).to(device)
    draws = {"states": params.states, "paths": params.paths, "seed": params.seed}
    visits = visit(simulator(params.simulation), law, start.to(device), params.frames, **draws)
    write_arrays(output.visited, visits.arrays(), {"dt": dt})
    run.log(f"{len(visits.F)} states and {visits.C.shape[1]} paths, from step {visits.frames[0]} on")


run_script(main, snakemake)
