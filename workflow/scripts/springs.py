"""Fit a network of springs to a video (Spring-Gaus)."""

from dataclasses import asdict

import torch

from neuma_lib.config.material import MaterialConfig
from neuma_lib.config.springs import SpringsConfig
from neuma_lib.device import choose_device
from neuma_lib.fitting.material import PixelLoss
from neuma_lib.fitting.springs import fit_springs
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.io.files import write_json
from neuma_lib.io.images import load_videos
from neuma_lib.io.particles import load_body, with_motion
from neuma_lib.io.springs import save_springs
from neuma_lib.sim.model import MPMModel
from neuma_lib.springs.body import SpringBody
from neuma_lib.springs.network import Springs
from neuma_lib.springs.rollout import SpringModel
from workflow.provenance import fingerprint
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    settings, how = MaterialConfig(**params.material), SpringsConfig(**params.springs)
    device = choose_device(params.device)
    files = (inputs.particles, inputs.binding, inputs.gaussians)
    body = load_body(*files, params.density, gaussian_motion=settings.gaussian_motion)
    body = body.to(torch.float32, device)
    videos = [
        video.to(torch.float32, device)
        for video in load_videos(inputs.transforms, settings.views, **params.filming)
    ]
    start, density = with_motion(body, inputs.velocity), float(body.mass.sum() / body.vol0.sum())
    network = (how.anchors, how.neighbours, how.hard_springs, how.exponent, how.carriers)
    anchored = SpringBody.of(body.x0, *network)
    springs = Springs.of_modulus(anchored.network, how.guess, density, how.resistance, how.gap)
    stamp = {
        "simulation": params.simulation,
        "filming": params.filming,
        "density": params.density,
        **params.material,
        **params.springs,
    }
    read = {name: inputs[name] for name in ("particles", "binding", "gaussians", "transforms", "velocity")}
    checkpoint = Checkpoint(params.checkpoint, fingerprint(stamp, read, params.code))
    fitted = fit_springs(
        SpringModel.of(MPMModel(**params.simulation), how.substeps),
        anchored,
        springs,
        start,
        PixelLoss(body, videos, settings.covariance_gradient, compare=settings.compare),
        settings,
        how,
        checkpoint=checkpoint,
        progress=run.progress,
        log=run.say,
    )
    curves = asdict(fitted.history)
    del curves["seconds"]  # the same settings give the same file
    report = {"best_loss": fitted.best_loss, "best_iteration": fitted.best_iteration}
    report |= {"stable": fitted.stable, "substeps": fitted.substeps}
    write_json(output.history, {**report, **curves})
    about = {"settings": {**params.material, **params.springs}, "density": density, **report}
    save_springs(output.springs, anchored, fitted.springs, about)
    checkpoint.remove()
    run.say(fitted.summary(density))


run_script(main, snakemake)
