"""Train a neural constitutive law on an analytic one."""

from neuma_lib.config.priors import RegressionConfig, TrajectoryConfig
from neuma_lib.fitting.prior_training import train_prior
from neuma_lib.io.files import write_json
from neuma_lib.io.weights import write_weights
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    kind = {"regression": RegressionConfig, "trajectory": TrajectoryConfig}[params.method]
    law, report = train_prior(params.law, kind(**params.options), params.seed, run.progress)
    write_weights(
        output.weights, law.prior_state(), {"prior": params.name, "law": params.law, "method": params.method}
    )
    write_json(output.report, report)
    run.say(
        f"rollout against its law: RMSE {1e3 * report['rmse']:.2f} mm, Chamfer {report['chamfer']:.4f}e-4 m^2"
    )


run_script(main, snakemake)
