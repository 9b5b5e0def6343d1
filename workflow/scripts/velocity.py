"""Estimate the initial velocity from the frames before contact."""

from neuma_lib.artifacts import load_body, load_law, load_observation
from neuma_lib.fitting.velocity import estimate_velocity
from neuma_lib.io import write_json
from neuma_lib.progress import stage
from neuma_lib.sim import MPMModel


def main(inputs, velocity_file: str, params, run) -> None:
    options = dict(params.velocity)
    estimate = estimate_velocity(
        MPMModel(**params.simulation),
        load_law(inputs.prior),
        load_body(inputs.binding, inputs.gaussians, params.density),
        load_observation(inputs.transforms, options.pop("views")),
        **options,
        progress=run.progress,
    )
    write_json(velocity_file, estimate.as_dict())
    run.say(estimate.summary())


if __name__ == "__main__":
    with stage(f"velocity {snakemake.wildcards.scene}", snakemake.log[0]) as run:
        main(snakemake.input, snakemake.output.velocity, snakemake.params, run)
