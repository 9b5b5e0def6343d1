"""Stress curves of the prior, the identified constants and the learned law of a capture, in units of its room."""

import torch

from neuma_lib.evaluation.bands import DRAWS, constants_draws, corrected_draws
from neuma_lib.evaluation.plotting.style import save
from neuma_lib.evaluation.stress_curves import draw, stress_curves
from neuma_lib.io.files import read_json, write_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.laws import load_laws
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    motion, _ = read_arrays(inputs.rollout, required=("F",), only=("F",))
    F, files = torch.from_numpy(motion["F"]), iter(inputs.laws)
    drawn = {"dt": params.dt, "count": DRAWS, "seed": params.seed}
    laws, draws = {}, {}
    for method, kinds in params.laws.items():
        parts = {kind: next(files) for kind in kinds}  # the files of all laws are in one list
        given = [[parts[kind]] if kind in parts else [] for kind in ("identified", "prior", "adaptor")]
        (laws[method],) = load_laws(params.dt, (), *given)
        identified = read_json(parts["identified"]) if "identified" in parts else {}
        if "best" in identified:  # constants with their covariance
            draws[method] = constants_draws(identified, params.model_std, **drawn)
        elif "base" in parts and laws[method].elasticity.form == "stretch":
            before = {"model_std": params.model_std, "spread": params.spread}
            draws[method] = corrected_draws(
                laws[method], read_json(parts["base"])["best"], F, **before, **drawn
            )
    curves = stress_curves(
        laws, params.method, F, params.rate, params.total_shear, params.dt, draws, params.scale
    )
    write_json(output.curves, curves)
    save(draw(curves, params.titles), output.picture)
    run.say(f"{len(laws)} laws, bands of {', '.join(draws) or 'none'}")


run_script(main, snakemake)
