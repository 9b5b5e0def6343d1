"""Estimate the initial velocity from the frames before contact."""

import torch

from neuma_lib.config.velocity import VelocityConfig
from neuma_lib.device import choose_device
from neuma_lib.fitting.velocity import estimate_velocities, estimate_velocity
from neuma_lib.io.files import listed, write_json
from neuma_lib.io.images import load_videos
from neuma_lib.io.laws import load_prior
from neuma_lib.io.particles import load_reconstruction
from neuma_lib.io.simulator import simulator
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    settings = VelocityConfig(**params.velocity)
    device = choose_device(params.device)
    model = simulator(params.simulation)
    law = load_prior(inputs.prior, device, model.dt)
    names = ("particles", "binding", "gaussians", "transforms")
    bodies, videos = [], []
    for *files, transforms, density in zip(
        *(listed(inputs[name]) for name in names), params.densities, strict=True
    ):
        bodies.append(load_reconstruction(*files, density).to(torch.float32, device))
        loaded = load_videos(transforms, settings.views, **params.exposure)
        videos.append([video.to(torch.float32, device) for video in loaded])

    def estimated(settings: VelocityConfig, progress=None):
        if len(bodies) == 1:
            return [estimate_velocity(model, law, bodies[0], videos[0], settings, progress)]
        return estimate_velocities(model, law, bodies, videos, settings, progress)

    estimates = estimated(settings, run.progress)
    free = estimated(settings.model_copy(update={"ridge": 0.0})) if settings.ridge else estimates
    motions = []
    for estimate, other in zip(estimates, free, strict=True):
        if settings.ridge:
            run.log(f"without the ridge: {other.summary()}")
        motions.append({**estimate.as_dict(), "without_ridge": other.as_dict()})
        run.log(estimate.summary())
    write_json(output.velocity, motions[0] if len(motions) == 1 else {"bodies": motions})


run_script(main, snakemake)
