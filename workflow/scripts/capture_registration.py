"""Register the photographed object in the video of a take, and estimate its motion."""

import shutil

import numpy as np
import torch

from neuma_lib.capture.masks.mattes import Mattes, metric_camera
from neuma_lib.capture.motion.gravity import GRAVITY, Gravity
from neuma_lib.capture.motion.synchronisation import frame_times
from neuma_lib.capture.pictures import evidence, picture_sheet
from neuma_lib.capture.registration.registration import Parabola, check_overlap, register
from neuma_lib.capture.registration.rigid_views import Sight
from neuma_lib.errors import InputError
from neuma_lib.io.files import atomic, listed, read_json, write_json
from neuma_lib.io.gaussians import load_gaussians, save_gaussians
from neuma_lib.io.images import read_hidden, read_transforms
from neuma_lib.io.particles import load_particles, save_particles
from neuma_lib.io.ply import read_ply, write_ply
from neuma_lib.splatting.rigid import moved
from workflow.stage import run_script

KNOWN_SPIN = 3.0
"""Standard deviation of a measured spin above which the search starts without it [rad/s]."""


def main(inputs, output, params, run) -> None:
    flight, gaussians = read_json(inputs.flight), load_gaussians(inputs.gaussians)
    flights = [read_json(file) for file in listed(inputs.flights)]  # of all bodies
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
    registered = register(
        gaussians,
        x.double().numpy(),
        vol0.double().numpy(),  # of one density
        sights,
        parabola(flight, scale, np.asarray(world.get("offset", 0.0)), scale_known),
        params.name,
        scale_known,
        run.progress,
        floor=float(world.get("offset", [0.0, 0.0, 0.0])[1]),
        start=max(each["start_s"] for each in flights) if len(flights) > 1 else None,
    )
    gravity = Gravity(
        registered.gravity / scale,
        registered.gravity_covariance / scale**2,
        f"the placed object in {registered.pictures[0]} pictures",
        len(sights) > 1,
    )

    def draw(path) -> None:
        draw_comparisons(path, registered, params.name)

    with evidence(output.picture, draw):
        check_overlap(registered, params.name)
        line = gravity.check(params.name) if scale_known else gravity.describe(params.name)
    placed = registered.place(x.double().numpy())
    if placed.min() < 0 or placed.max() > 1:
        raise InputError(
            params.name,
            f"the object starts at {placed.min():.2f} to {placed.max():.2f}, outside the simulation box [0, 1] shown in"
            " floor.png",
            "Set `center` or a smaller `scale` in capture.yaml",
        )
    R, t = torch.from_numpy(registered.rotation), torch.from_numpy(registered.translation)
    save_gaussians(output.gaussians, moved(gaussians, R, t, registered.scale))
    vertices, faces = read_ply(inputs.mesh)
    corners = np.stack([vertices[axis] for axis in "xyz"], axis=1)
    for axis, values in zip("xyz", registered.place(corners).T):
        vertices[axis] = values
    write_ply(output.mesh, vertices, faces)
    for source, target in ((inputs.sampled, output.sampled), (inputs.particles, output.particles)):
        x, vol0, attributes = load_particles(source)
        placed = torch.from_numpy(registered.place(x.double().numpy()))
        save_particles(target, placed.to(x), registered.scale**3 * vol0, attributes)
    with atomic(output.binding) as partial:
        shutil.copyfile(inputs.binding, partial)
    draw(output.picture)
    write_json(output.velocity, registered.velocity())
    write_json(output.registration, {**registered.report(), **gravity.report(), "gravity": line})
    run.log(registered.summary())
    run.log(line)
    if registered.ambiguous:
        run.log(f"undetermined: {registered.ambiguous}")


def draw_comparisons(path, registered, name) -> None:
    pictures = []
    for compared in registered.comparisons:
        triple = [compared.seen, compared.rendered, (1 + compared.rendered - compared.seen) / 2]
        pixels = np.rint(255 * np.concatenate(triple, axis=1).clip(0, 1)).astype(np.uint8)
        camera = registered.names[compared.camera]
        pictures.append((f"{camera}, {compared.time:.4f} s: seen, rendered, difference", pixels))
    picture_sheet(path, pictures, f"{name}: {registered.summary()}", columns=3)


def sight(camera, transforms, timeline, row_time, flight, name) -> Sight:
    """Frames of one camera during free flight."""
    mattes = Mattes(transforms)
    first, last = flight["frames"][camera]
    flying = [k for k, frame in enumerate(mattes.frames) if first <= frame["step"] <= last]
    if not flying:
        problem = f"{transforms} has none of the frames {first} to {last} of the flight"
        raise InputError(f"{name}, {camera}", problem)
    frames, pixels = [mattes.frames[k] for k in flying], np.stack([mattes[k] for k in flying])
    times = frame_times(frames, pixels, row_time, read_json(timeline)["height"])
    known = flight["offsets_deviation_s"][camera] == 0
    viewmat, K = metric_camera(frames[0], {})
    hidden = read_hidden(transforms)
    hidden = None if hidden is None else hidden[flying]
    return Sight(camera, times, pixels, viewmat, K, flight["offsets_s"][camera], known, hidden)


def parabola(flight, scale, offset, metric) -> Parabola:
    """The flight of the masks' centre, converted from metres of the room to simulated metres.

    Gravity is 9.81 m/s^2, or the measured value if lengths are not metres.
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
