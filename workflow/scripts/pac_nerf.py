"""Find velocity and constants in a video through a radiance field and the simulation (PAC-NeRF)."""

from dataclasses import asdict

import torch

from neuma_lib.config.pac_nerf import PacNerfConfig
from neuma_lib.device import choose_device
from neuma_lib.errors import InputError
from neuma_lib.fitting.carried_field import CarriedField
from neuma_lib.fitting.pac_families import choose_family
from neuma_lib.fitting.pac_nerf import fit_pac_nerf
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.io.files import read_json, write_json
from neuma_lib.io.images import load_videos
from neuma_lib.io.radiance import load_field
from neuma_lib.sim.model import MPMModel
from workflow.provenance import fingerprint
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    settings, device = PacNerfConfig(**params.pac_nerf), choose_device(params.device)
    family, constants = choose_family(settings, params.prior)
    guess = constants.specification()
    run.say(f"family {family}, from {settings.guesses} guesses: {guess}")
    field, _ = load_field(inputs.field)
    body = CarriedField(field.to(device), **params.radiance, settings=settings, density=params.density)
    found = read_json(inputs.velocity)
    if not found.get("frames"):
        raise InputError(f"{inputs.velocity} names no frames before contact: run the rule velocity again")
    stamp = {key: params[key] for key in ("simulation", "density", "views", "radiance", "seed")}
    read = {name: inputs[name] for name in ("field", "transforms", "velocity")}
    checkpoint = Checkpoint(
        params.checkpoint, fingerprint({**stamp, "guess": guess, **params.pac_nerf}, read, params.code)
    )
    model = MPMModel(**params.simulation)
    video, *others = load_videos(inputs.transforms, params.views, **params.filming)
    if others or video.exposure != (0,):
        raise InputError(
            f"{inputs.transforms}: pac_nerf compares pictures of an instant that all its views took at the same steps; "
            f"views {params.views} differ in steps, size or exposure, or have one: choose one view by "
            "methods.<name>.material.views, and ignore its blur by dataset.sub_frames: 1"
        )
    fit = fit_pac_nerf(
        model,
        body,
        video.to(torch.float32, device),
        found["frames"][-1],
        constants,
        settings,
        params.seed,
        checkpoint=checkpoint,
        progress=run.progress,
        log=run.say,
    )
    curves = asdict(fit.history)
    del curves["seconds"]  # the same settings give the same file
    start = {"v0": fit.velocity.tolist(), "angular_velocity": [0.0, 0.0, 0.0]}
    centre = body.mass @ body.moving.x / body.mass.sum()
    law = constants.specification()
    about = {
        "family": family,
        "law": law,
        "guess": guess,
        "guesses": settings.guesses,
        "fitted": constants.fitted,
    }
    write_json(output.constants, {**about, "start": {**start, "centre": centre.tolist()}})
    write_json(output.history, {**curves, "velocity_loss": fit.velocity_losses})
    checkpoint.remove()
    run.say(fit.summary())


run_script(main, snakemake)
