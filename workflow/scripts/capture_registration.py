"""Place the photographed object into the video of a throw, and find how it moves there."""

import shutil

import numpy as np
import torch

from neuma_lib.capture.clock import frame_times
from neuma_lib.capture.free_fall import GRAVITY
from neuma_lib.capture.pictures import picture_sheet
from neuma_lib.errors import InputError
from neuma_lib.fitting.registration import Parabola, register
from neuma_lib.fitting.rigid_views import Sight
from neuma_lib.io.files import atomic, read_json, write_json
from neuma_lib.io.gaussians import load_gaussians, save_gaussians
from neuma_lib.io.images import read_image_set, read_transforms
from neuma_lib.io.particles import load_particles, save_particles
from neuma_lib.io.ply import read_ply, write_ply
from neuma_lib.splatting.rigid import moved
from workflow.inputs import listed
from workflow.stage import run_script

KNOWN_SPIN = 3.0
"""Deviation of a measured spin above which the search begins without it [rad/s]."""


def main(inputs, output, params, run) -> None:
    flight, gaussians = read_json(inputs.flight), load_gaussians(inputs.gaussians)
    x, vol0, _ = load_particles(inputs.particles)
    files = zip(
        params.cameras,
        listed(inputs.transforms),
        listed(inputs.timelines),
        params.timing["row_times"],
        strict=True,
    )
    sights = [sight(*values, flight) for values in files]
    world = read_transforms(listed(inputs.transforms)[0]).get("world", {})
    found = register(
        gaussians,
        x.double().numpy(),
        vol0.double().numpy(),  # of one density
        sights,
        parabola(flight, world.get("scale", 1.0), np.asarray(world.get("offset", 0.0))),
        params.name,
        run.progress,
    )
    R, t = torch.from_numpy(found.rotation), torch.from_numpy(found.translation)
    placed = x.double() @ R.mT + t
    if placed.min() < 0 or placed.max() > 1:
        raise InputError(
            f"{params.name}: the flight begins outside the simulator's box, which is shown in floor.png: move it by"
            " `center` in capture.yaml, or make it larger with `scale`"
        )
    save_gaussians(output.gaussians, moved(gaussians, R, t))
    vertices, faces = read_ply(inputs.mesh)
    corners = np.stack([vertices[axis] for axis in "xyz"], axis=1) @ found.rotation.T + found.translation
    for axis, values in zip("xyz", corners.T):
        vertices[axis] = values
    write_ply(output.mesh, vertices, faces)
    for source, target in ((inputs.sampled, output.sampled), (inputs.particles, output.particles)):
        x, vol0, attributes = load_particles(source)
        save_particles(target, (x.double() @ R.mT + t).to(x), vol0, attributes)
    with atomic(output.binding) as partial:
        shutil.copyfile(inputs.binding, partial)
    pictures = []
    for shown in found.shown:
        triple = [shown.seen, shown.rendered, (1 + shown.rendered - shown.seen) / 2]
        pixels = np.rint(255 * np.concatenate(triple, axis=1)).astype(np.uint8)
        pictures.append(
            (f"{found.names[shown.camera]}, {shown.time:.4f} s: seen, rendered, difference", pixels)
        )
    picture_sheet(output.picture, pictures, f"{params.name}: {found.summary()}", columns=3)
    write_json(output.velocity, found.velocity())
    write_json(output.registration, found.report())
    run.say(found.summary())
    if found.ambiguous:
        run.say(f"not told: {found.ambiguous}")


def sight(camera, transforms, timeline, row_time, flight) -> Sight:
    """What a camera saw of the free flight."""
    data, images = read_transforms(transforms), read_image_set(transforms)
    first, last = flight["frames"][camera]
    flying = [k for k, step in enumerate(images.steps) if first <= step <= last]
    frames, pixels = [data["frames"][k] for k in flying], images.images[flying]
    rows = np.array([np.flatnonzero(image[..., 3].any(axis=1)).mean() + 0.5 for image in pixels])
    times = frame_times(frames, rows, row_time, read_json(timeline)["height"])
    known = flight["offsets_deviation_s"][camera] == 0
    return Sight(camera, times, pixels, images.viewmats[0], images.Ks[0], flight["offsets_s"][camera], known)


def parabola(flight, scale, offset) -> Parabola:
    """The flight of the masks' centre, from the room's metres to those of the simulator."""
    spin, sure = flight["spin_rad_s"], flight["spin_deviation_rad_s"]
    return Parabola(
        flight["start_s"],
        scale * np.array(flight["x0_m"]) + offset,
        scale * np.array(flight["v0_m_s"]),
        np.array([0.0, -GRAVITY * scale, 0.0]),
        np.array(spin) if spin and np.linalg.norm(sure) < KNOWN_SPIN else None,
    )


run_script(main, snakemake)
