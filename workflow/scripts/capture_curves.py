"""Stress curves of the prior, the identified constants and the learned law of a capture, in units of its room."""

import torch

from neuma_lib.evaluation.bands import DRAWS
from neuma_lib.evaluation.plotting.style import save
from neuma_lib.evaluation.stress_curves import draw, stress_curves
from neuma_lib.io.files import parse_json, write_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.methods.base import method_of
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    motion, about = read_arrays(inputs.rollout, required=("F",), only=("F",))
    counts = parse_json(about["particles"], inputs.rollout)
    uncertainty = {"model_std": params.model_std, "spread": params.spread}
    drawn = {"dt": params.dt, "count": DRAWS, "seed": params.seed}
    curves = {}
    for (body, sources), F in zip(
        params.laws.items(), torch.from_numpy(motion["F"]).split(counts, dim=1), strict=True
    ):
        laws, draws = {}, {}
        for name, source in sources.items():
            method, options = method_of(source["module"]), source["options"][0]
            laws[name] = method.load(source["files"], options, params.dt).law
            own = {key: options[key] for key in ("body",) if key in options}
            if drawn_laws := method.draws(source["uncertainty"], laws[name], F, uncertainty, **drawn, **own):
                draws[name] = drawn_laws
        curves[body] = stress_curves(
            laws, params.method, F, params.rate, params.total_shear, params.dt, draws, params.scale
        )
        run.log(" ".join(filter(None, [body, f"{len(laws)} laws, bands of {', '.join(draws) or 'none'}"])))
    write_json(output.curves, curves.get("", {"bodies": curves}))
    save(draw(curves, params.titles), output.picture)


run_script(main, snakemake)
