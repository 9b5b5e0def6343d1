"""Compare the stresses of a law with the true ones, on states that the true law went through."""

from neuma_lib.evaluation.stress import VisitedStates, stress_errors
from neuma_lib.io.files import write_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.mechanics.analytic import analytic_law
from workflow.motion import Prediction
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    law = Prediction(inputs, params.method).law(params.dt)
    arrays, _ = read_arrays(inputs.visited, required=("F", "F_trial", "C", "frames"))
    truth = analytic_law(params.truth, params.dt)
    errors = stress_errors(law, truth, VisitedStates.of_arrays(arrays), params.dt)
    write_json(output.stress, errors)
    run.log(", ".join(f"{part} {errors[part]:.3f}" for part in ("stress", "returned")))


run_script(main, snakemake)
