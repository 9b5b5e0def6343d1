"""Place the photographed object into the video of a throw, and find how it moves there."""

import shutil

import numpy as np
import torch

from neuma_lib.capture.clock import frame_times
from neuma_lib.capture.gravity import GRAVITY, Gravity
from neuma_lib.capture.pictures import picture_sheet
from neuma_lib.errors import InputError
from neuma_lib.fitting.registration import Parabola, register
from neuma_lib.fitting.rigid_views import Sight
from neuma_lib.io.files import atomic, listed, read_json, write_json
from neuma_lib.io.gaussians import load_gaussians, save_gaussians
from neuma_lib.io.images import read_image_set, read_transforms
from neuma_lib.io.particles import load_particles, save_particles
from neuma_lib.io.ply import read_ply, write_ply
from neuma_lib.splatting.rigid import moved
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
    sights = [sight(*values, flight, params.name) for values in files]
    world = read_transforms(listed(inputs.transforms)[0]).get("world", {})
    scale = world.get("scale", 1.0)
    scale_known = read_transforms(inputs.photographs).get("scale_known", True)
    found = register(
        gaussians,
        x.double().numpy(),
        vol0.double().numpy(),  # of one density
        sights,
        parabola(flight, scale, np.asarray(world.get("offset", 0.0)), scale_known),
        params.name,
        scale_known,
        run.progress,
        floor=float(world.get("offset", [0.0, 0.0, 0.0])[1]),
    )
    gravity = Gravity(
        found.gravity / scale,
        found.gravity_covariance / scale**2,
        f"the placed object in {found.pictures[0]} pictures",
        len(sights) > 1,
    )
    line = gravity.checked(params.name) if scale_known else gravity.told(params.name)
    placed = found.place(x.double().numpy())
    if placed.min() < 0 or placed.max() > 1:
        raise InputError(
            f"{params.name}: the flight begins outside the simulator's box, which is shown in floor.png: move it by"
            " `center` in capture.yaml, or make it larger with `scale`"
        )
    R, t = torch.from_numpy(found.rotation), torch.from_numpy(found.translation)
    save_gaussians(output.gaussians, moved(gaussians, R, t, found.scale))
    vertices, faces = read_ply(inputs.mesh)
    corners = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    for axis, values in zip("xyz", found.place(corners).T):
        vertices[axis] = values
    write_ply(output.mesh, vertices, faces)
    for source, target in ((inputs.sampled, output.sampled), (inputs.particles, output.particles)):
        x, vol0, attributes = load_particles(source)
        placed = torch.from_numpy(found.place(x.double().numpy()))
        save_particles(target, placed.to(x), found.scale**3 * vol0, attributes)
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
    write_json(output.registration, {**found.report(), **gravity.report(), "gravity": line})
    run.say(found.summary())
    run.say(line)
    if found.ambiguous:
        run.say(f"not told: {found.ambiguous}")


def sight(camera, transforms, timeline, row_time, flight, name) -> Sight:
    """What a camera saw of the free flight."""
    data, images = read_transforms(transforms), read_image_set(transforms)
    first, last = flight["frames"][camera]
    flying = [k for k, step in enumerate(images.steps) if first <= step <= last]
    if not flying:
        raise InputError(
            f"{name}, {camera}: {transforms} has none of the frames {first} to {last} of the flight"
        )
    frames, pixels = [data["frames"][k] for k in flying], images.images[flying]
    rows = np.array([np.flatnonzero(image[..., 3].any(axis=1)).mean() + 0.5 for image in pixels])
    times = frame_times(frames, rows, row_time, read_json(timeline)["height"])
    known = flight["offsets_deviation_s"][camera] == 0
    return Sight(camera, times, pixels, images.viewmats[0], images.Ks[0], flight["offsets_s"][camera], known)


def parabola(flight, scale, offset, metric) -> Parabola:
    """The flight of the masks' centre, from the room's metres to those of the simulator.

    Gravity is known, but measured where lengths are not metres.
    """
    gravity = [0.0, -GRAVITY, 0.0] if metric else flight["gravity_m_s2"]
    spin, sure = flight["spin_rad_s"], flight["spin_deviation_rad_s"]
    return Parabola(
        flight["start_s"],
        scale * np.array(flight["x0_m"]) + offset,
        scale * np.array(flight["v0_m_s"]),
        scale * np.array(gravity),
        np.array(spin) if spin and np.linalg.norm(sure) < KNOWN_SPIN else None,
    )


run_script(main, snakemake)
