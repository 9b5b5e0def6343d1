"""Tests of material points of a law, over the range of states that the true law visits, with what its video allows."""

import torch

from neuma_lib.evaluation.bands import DRAWS, constants_draws, corrected_draws
from neuma_lib.evaluation.response import material_tests, response
from neuma_lib.io.files import read_json, write_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.laws import load_laws
from neuma_lib.mechanics.analytic import analytic_law
from workflow.inputs import listed
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    files = [listed(inputs.get(name)) for name in ("identified", "prior", "adaptor")]
    (law,) = load_laws(params.dt, params.laws, *files)
    visited, _ = read_arrays(inputs.visited, required=("F",), only=("F",))
    truth = analytic_law(params.truth, params.dt)
    tests = material_tests(truth, torch.from_numpy(visited["F"]), params.rate, params.total_shear, params.dt)
    draws, drawn = [], {"dt": params.dt, "count": DRAWS, "seed": params.seed}
    found = read_json(inputs.identified) if inputs.get("identified") else {}
    if "best" in found:  # constants that come with their covariance
        draws = constants_draws(found, params.model_std, **drawn)
    elif inputs.get("base"):
        motion, _ = read_arrays(inputs.rollout, required=("F",), only=("F",))
        fit = read_json(inputs.base)["best"]
        before = {"model_std": params.model_std, "spread": params.spread}
        draws = corrected_draws(law, fit, torch.from_numpy(motion["F"]), **before, **drawn)
    write_json(output.response, {name: response(law, truth, test, draws) for name, test in tests.items()})
    run.say(f"{len(tests)} tests" + (f", bands of {len(draws)} laws" if draws else ""))


run_script(main, snakemake)
