"""Adapt the material law to one video or several, or to ground-truth particles."""

from dataclasses import asdict

import torch

from neuma_lib.config.material import MaterialConfig
from neuma_lib.config.structured import StructuredConfig
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.device import choose_device
from neuma_lib.fitting.material import ParticleLoss, PixelLoss, train_material
from neuma_lib.fitting.structured_fit import rival_bases, train_structured
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.io.files import read_json, write_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import load_videos
from neuma_lib.io.laws import load_adaptable, save_adaptor
from neuma_lib.io.particles import load_body, with_motion
from neuma_lib.mechanics.structured import structured_law
from neuma_lib.sim.model import MPMModel
from workflow.inputs import listed
from workflow.provenance import fingerprint
from workflow.stage import run_script


def particle_loss(truth: str, device: torch.device) -> ParticleLoss:
    found, _ = read_arrays(truth, required=("x", "frames"), only=("x", "frames"))
    return ParticleLoss(tuple(found["frames"].tolist()), torch.from_numpy(found["x"]).to(device))


def pixel_loss(body: Reconstruction, transforms: str, settings: MaterialConfig, filming: dict) -> PixelLoss:
    videos = [
        video.to(body.x0.dtype, body.x0.device)
        for video in load_videos(transforms, settings.views, **filming)
    ]
    total = settings.covariance_from == "total"
    return PixelLoss(body, videos, settings.covariance_gradient, total=total, compare=settings.compare)


def main(inputs, output, params, run) -> None:
    settings = MaterialConfig(**params.material)
    device = choose_device(params.device)
    structured = StructuredConfig(**params.structured) if params.structured else None
    if structured:
        bases = [params.base]
        if not params.base:
            identified = read_json(inputs.identified)
            bases = [identified["law"], *rival_bases(identified, structured.rivals)]
        laws = [
            structured_law({**base, "form": structured.form}, params.simulation["dt"], seed=settings.seed)
            for base in bases
        ]
    else:
        laws = [load_adaptable(inputs.prior, params.simulation["dt"])]
    laws = [law.to(device) for law in laws]
    for law in laws:
        law.attach_adaptor(settings.rank, settings.alpha, settings.seed)
    parts = zip(*(listed(inputs[name]) for name in ("particles", "binding", "gaussians")), strict=True)
    bodies = [
        load_body(*files, density, settings.carrier, settings.gaussian_motion).to(torch.float32, device)
        for files, density in zip(parts, params.densities, strict=True)
    ]
    starts = [with_motion(body, file) for body, file in zip(bodies, listed(inputs.velocity), strict=True)]
    if settings.supervision == "particles":
        losses = [particle_loss(file, device) for file in listed(inputs.truth)]
    else:
        losses = [
            pixel_loss(body, file, settings, params.filming)
            for body, file in zip(bodies, listed(inputs.transforms), strict=True)
        ]
    files = {
        f"{name} {k}": file
        for name, found in inputs.items()
        if name != "kernels"
        for k, file in enumerate(listed(found))
    }
    stamp = {
        "simulation": params.simulation,
        "filming": params.filming,
        "densities": params.densities,
        **params.material,
    }
    stamp |= {"base": params.base, **params.structured} if structured else {}
    checkpoint = Checkpoint(params.checkpoint, fingerprint(stamp, files, params.code))
    problem = (MPMModel(**params.simulation), laws[0], starts[0], losses[0], settings)
    options = {"checkpoint": checkpoint, "progress": run.progress, "log": run.say}
    options["further"] = list(zip(starts[1:], losses[1:], strict=True))
    choice = {}
    if structured:
        trained, chosen = train_structured(*problem, structured, rivals=laws[1:], **options)
        choice = chosen.as_dict()
        run.say(chosen.summary())
    else:
        trained = train_material(*problem, **options)
    report = {
        "best_loss": trained.best_loss,
        "best_iteration": trained.best_iteration,
        "stable": trained.stable,
    }
    curves = asdict(trained.history)
    del curves["seconds"]  # the same settings give the same file
    write_json(output.history, {**report, **choice, **curves})
    about = {"settings": params.material | (params.structured or {}), **report}
    save_adaptor(output.adaptor, trained.law, settings.rank, settings.alpha, about)
    checkpoint.remove()
    run.say(trained.summary())


run_script(main, snakemake)
