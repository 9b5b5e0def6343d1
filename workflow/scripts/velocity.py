"""Estimate the initial velocity from the frames before contact."""

import torch

from neuma_lib.config.velocity import VelocityConfig
from neuma_lib.device import choose_device
from neuma_lib.fitting.velocity import estimate_velocity
from neuma_lib.io.files import write_json
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
    body = load_reconstruction(inputs.particles, inputs.binding, inputs.gaussians, params.density)
    body = body.to(torch.float32, device)
    videos = [
        video.to(torch.float32, device)
        for video in load_videos(inputs.transforms, settings.views, **params.exposure)
    ]
    estimate = estimate_velocity(model, law, body, videos, settings, run.progress)
    free = estimate
    if settings.ridge:
        free = estimate_velocity(model, law, body, videos, settings.model_copy(update={"ridge": 0.0}))
        run.log(f"without the ridge: {free.summary()}")
    write_json(output.velocity, {**estimate.as_dict(), "without_ridge": free.as_dict()})
    run.log(estimate.summary())


run_script(main, snakemake)
