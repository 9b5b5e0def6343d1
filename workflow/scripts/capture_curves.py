"""Stress curves of the prior, the identified constants and the learned law of a capture, in units of its room."""

import torch

from neuma_lib.evaluation.bands import DRAWS
from neuma_lib.evaluation.plotting.style import save
from neuma_lib.evaluation.stress_curves import draw, stress_curves
from neuma_lib.io.files import write_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.methods.base import method_of
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    motion, _ = read_arrays(inputs.rollout, required=("F",), only=("F",))
    F = torch.from_numpy(motion["F"])
    uncertainty = {"model_std": params.model_std, "spread": params.spread}
    drawn = {"dt": params.dt, "count": DRAWS, "seed": params.seed}
    laws, draws = {}, {}
    for name, source in params.laws.items():
        method, files = method_of(source["module"]), source["files"]
        laws[name] = method.load(files, source["options"][0], params.dt).law
        if drawn_laws := method.draws(files, laws[name], F, uncertainty, **drawn):
            draws[name] = drawn_laws
    curves = stress_curves(
        laws, params.method, F, params.rate, params.total_shear, params.dt, draws, params.scale
    )
    write_json(output.curves, curves)
    save(draw(curves, params.titles), output.picture)
    run.log(f"{len(laws)} laws, bands of {', '.join(draws) or 'none'}")


run_script(main, snakemake)
