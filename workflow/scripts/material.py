"""Adapt the material law to the video, or to ground-truth particles."""

from dataclasses import asdict

import torch

from neuma_lib.config.material import MaterialConfig
from neuma_lib.device import choose_device
from neuma_lib.fitting.material import ParticleLoss, PixelLoss, train_material
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.io.files import write_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import load_observation
from neuma_lib.io.laws import load_law, save_adaptor
from neuma_lib.io.particles import load_body, thrown
from neuma_lib.sim.model import MPMModel
from workflow.provenance import fingerprint
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    settings = MaterialConfig(**params.material)
    device = choose_device(params.device)
    law = load_law(inputs.prior).to(device)
    law.attach_adaptor(settings.rank, settings.alpha, settings.seed)
    body = load_body(inputs.particles, inputs.binding, inputs.gaussians, params.density, settings.carrier)
    body = body.to(torch.float32, device)
    if settings.supervision == "particles":
        truth, _ = read_arrays(inputs.truth, required=("x", "frames"), only=("x", "frames"))
        targets = torch.from_numpy(truth["x"]).to(device)
        loss = ParticleLoss(tuple(truth["frames"].tolist()), targets)
    else:
        video = load_observation(inputs.transforms, settings.views).to(torch.float32, device)
        total = settings.covariance_from == "total"
        loss = PixelLoss(body, video, settings.covariance_gradient, total=total)
    files = {name: str(file) for name, file in inputs.items() if name != "kernels" and isinstance(file, str)}
    stamp = {"simulation": params.simulation, "density": params.density, **params.material}
    checkpoint = Checkpoint(params.checkpoint, fingerprint(stamp, files, params.code))
    trained = train_material(
        MPMModel(**params.simulation),
        law,
        thrown(body, inputs.velocity),
        loss,
        settings,
        checkpoint=checkpoint,
        progress=run.progress,
        log=run.say,
    )
    report = {
        "best_loss": trained.best_loss,
        "best_iteration": trained.best_iteration,
        "stable": trained.stable,
    }
    curves = asdict(trained.history)
    del curves["seconds"]  # the same settings give the same file
    write_json(output.history, {**report, **curves})
    save_adaptor(
        output.adaptor, trained.law, settings.rank, settings.alpha, {"settings": params.material, **report}
    )
    checkpoint.remove()
    run.say(trained.summary())


run_script(main, snakemake)
