"""Train a neural constitutive law on an analytic one."""

from neuma_lib.config.priors import RegressionConfig
from neuma_lib.fitting.prior_training import METHOD, remark, train_prior
from neuma_lib.io.files import read_json, write_json
from neuma_lib.io.weights import write_weights
from neuma_lib.mechanics.analytic import analytic_law
from workflow.stage import run_script


def at_step(spec: dict, dt: float) -> dict:
    """The law at the time step of the scene, since a network is defined for one time step."""
    depends = "dt" in analytic_law(spec, dt).plasticity.values
    return {**spec, "plasticity": {**spec["plasticity"], "dt": dt}} if depends else spec


def main(inputs, output, params, run) -> None:
    spec = params.get("law") or at_step(read_json(inputs.identified)["law"], params.dt)
    law, report = train_prior(spec, RegressionConfig(**params.options), params.seed, run.progress)
    write_weights(output.weights, law.prior_state(), {"prior": params.name, "law": spec, "method": METHOD})
    write_json(output.report, report)
    run.log(remark(report))


run_script(main, snakemake)
