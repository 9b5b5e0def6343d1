"""The loss of a method's law in the views of its training, beside that of the true law on the same reconstruction."""

from dataclasses import asdict

import torch

from neuma_lib.config.material import MaterialConfig
from neuma_lib.device import choose_device
from neuma_lib.evaluation.bias import bias_report, frame_losses
from neuma_lib.fitting.material import PixelLoss
from neuma_lib.io.files import write_json
from neuma_lib.io.images import load_videos
from neuma_lib.io.laws import load_laws
from neuma_lib.io.particles import load_body, with_motion
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.model import MPMModel
from workflow.inputs import listed
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    settings = MaterialConfig(**params.material)
    device = choose_device(params.device)
    files = (inputs.particles, inputs.binding, inputs.gaussians)
    body = load_body(*files, params.density, settings.carrier, settings.gaussian_motion)
    body = body.to(torch.float32, device)
    videos = [
        video.to(torch.float32, device)
        for video in load_videos(inputs.transforms, settings.views, **params.filming)
    ]
    loss = PixelLoss(body, videos, total=settings.covariance_from == "total", compare=settings.compare)
    model, start = MPMModel(**params.simulation), with_motion(body, inputs.velocity)
    truth = analytic_law(params.truth, dt=params.simulation["dt"])
    found = [listed(inputs.get(name)) for name in ("identified", "prior", "adaptor")]
    (law,) = load_laws(params.simulation["dt"], params.laws, *found)
    losses, failure = frame_losses(model, law.to(device), start, loss)
    true_losses, true_failure = frame_losses(model, truth.to(device), start, loss)
    report = bias_report(losses, true_losses)
    about = {"frames": list(loss.frames), "views": list(settings.views)}
    about |= {"diverged": failure and asdict(failure)}
    about |= {"true_law_diverged": true_failure and asdict(true_failure)}
    write_json(output.bias, {**report, **about})
    run.say(f"loss {report['loss']:.3e}, {report['ratio']:.2f} of the true law's")


run_script(main, snakemake)
