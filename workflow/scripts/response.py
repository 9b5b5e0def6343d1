"""Tests of material points of a law, over the range of states that the true law visits, with its uncertainty."""

import torch

from neuma_lib.evaluation.bands import DRAWS
from neuma_lib.evaluation.response import material_tests, response
from neuma_lib.io.files import write_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.mechanics.analytic import analytic_law
from workflow.motion import Prediction, files_of
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    prediction = Prediction(inputs, params.method)
    law = prediction.law(params.dt)
    visited, _ = read_arrays(inputs.visited, required=("F",), only=("F",))
    truth = analytic_law(params.truth, params.dt)
    tests = material_tests(truth, torch.from_numpy(visited["F"]), params.rate, params.total_shear, params.dt)
    files = files_of(inputs, params.uncertainty)
    uncertainty = {"model_std": params.model_std, "spread": params.spread}
    drawn = {"dt": params.dt, "count": DRAWS, "seed": params.seed}
    draws = prediction.method.draws(files, law, None, uncertainty, **drawn)
    write_json(output.response, {name: response(law, truth, test, draws) for name, test in tests.items()})
    run.log(f"{len(tests)} tests" + (f", bands of {len(draws)} laws" if draws else ""))


run_script(main, snakemake)
