"""Checks of a project's settings that run nothing and load no torch: laws, shapes, starts, time steps, views, the GPU.

`neuma check` and every call of Snakemake make the same checks, before the first job.
"""

import ctypes
import importlib.metadata
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from neuma_lib.config.obstacles import ColliderConfig, is_mesh_file
from neuma_lib.config.validation import hint
from neuma_lib.errors import InputError
from neuma_lib.mechanics.catalogue import (
    COURANT_LIMIT,
    DEFINED_IN,
    PARTS,
    check_law,
    longitudinal_modulus,
    stiffest,
    viscous_stiffness,
)
from neuma_lib.project.capture_scenes import checked_capture
from neuma_lib.project.consistency import prior_errors
from neuma_lib.project.random_scenes import LETTER, SHAPES, Proportions, flight, rotation_matrix
from neuma_lib.project.settings import Config

ROUND_OFF = 1e-6
CONTACT_CELLS = 2.5  # at least the width of the zone at a wall in which a body touches it [cells]


def problems(settings: Config) -> list[str]:
    """Problems of valid settings that stop every command, one line each."""
    return [
        *law_problems(settings),
        *_view_problems(settings),
        *_scene_problems(settings),
        *_experiment_problems(settings),
    ]


def local_problems(settings: Config) -> list[str]:
    """Problems that stop only what needs it, one line each: a missing GPU, a video without contact, captures."""
    return [
        *_device_problems(settings.device),
        *_contact_problems(settings),
        *_scene_problems(settings, own_captures=True),
    ]


def capture_problems(folders: Iterable[Path]) -> list[str]:
    """Problems of the capture.yaml, the name and the files of captures, one line each."""
    problems = []
    for folder in folders:
        try:
            checked_capture(folder)
        except InputError as error:
            problems += lines(error)
    return problems


def law_problems(settings: Config) -> list[str]:
    """Laws with an unknown name, an unknown or missing constant, or one outside its bounds, one line each."""
    return [problem for where, spec in _laws(settings) for problem in _checked(where, spec)[1]]


def lines(error: InputError) -> list[str]:
    """The problems in an error of the settings, one line each."""
    return [line.strip() for line in str(error).splitlines()]


def _laws(settings: Config) -> Iterator[tuple[str, dict[str, Any]]]:
    """All laws in the settings with their keys; of ranges the two ends."""
    drawn = {*settings.random_scenes, *settings.random_piles}
    for name, scene in settings.scenes.items():
        if scene.law is not None and name not in drawn and not scene.part_of:
            yield f"scenes.{name}.law", scene.law.plain()
        for key, body in scene.bodies.items() if name not in drawn else ():
            if body.law is not None:
                yield f"scenes.{name}.bodies.{key}.law", body.law.plain()
    for name, law in settings.priors.laws.items():
        yield f"priors.laws.{name}", law.plain()
    for name, law in settings.identify.families.items():
        yield f"identify.families.{name}", law.plain()
    for name, specimen in settings.specimens.items():
        yield f"specimens.{name}.law", specimen.law.plain()
    for name, family in settings.pac_nerf.families.items():
        yield f"pac_nerf.families.{name}", family.plain()
    for group in ("families", "outside"):
        for name, family in getattr(settings.random, group).items():
            for end in (0, 1):
                yield f"random.{group}.{name}", {key: part.at(end) for key, part in family.parts.items()}


def _checked(where: str, spec: Mapping[str, Any], dt: float = 1.0) -> tuple[dict[str, Any] | None, list[str]]:
    """A complete law, with the time step [s] in parts that depend on it, or None and its problem."""
    plain = {key: value for key, value in spec.items() if key in PARTS}
    try:
        return check_law(plain, dt), []
    except InputError as error:
        return None, [str(InputError(f"{where}.{error.where}", error.problem, error.remedy))]


def _scene_problems(settings: Config, own_captures: bool = False) -> Iterator[str]:
    """Problems of the scenes of own captures, or of all others."""
    priors = settings.priors.laws
    for name, scene in settings.scenes.items():
        if settings.is_own_capture(name) != own_captures:
            continue
        where, world, plain = f"scenes.{name}", settings.scene_world(name), scene.plain()
        if own_captures:
            yield from map(str, prior_errors(settings, name))
        yield from _mesh_problems(*settings.colliders(name))
        if scene.has_truth and not scene.part_of or scene.bodies and not own_captures:
            truth = settings.scene_truth(name)
            for body in settings.scene_bodies(name):
                own = f"{where}.bodies.{body['name']}" if scene.bodies else where
                yield from _start_problems(own, body, scene.dt, world["grid"], *settings.colliders(name))
                yield from _courant_problem(f"{own}.law", body["law"], body["density"], truth.grid, truth.dt)
        if scene.splat:
            reach = plain["size"] * math.sqrt(3) / 2
            yield from _speed_problem(where, plain, reach, scene.dt, world["grid"])
        if scene.prior in priors:
            spec, label = priors[scene.prior].plain(), f"{where}.prior = {scene.prior}"
            yield from _courant_problem(label, spec, plain["density"], world["grid"], scene.dt)


def _view_problems(settings: Config) -> Iterator[str]:
    """Views of videos that are rendered here, of which there are dataset.dynamic.views."""
    rendered = {
        name: scene
        for name, scene in settings.scenes.items()
        if scene.has_truth and scene.images.dynamic is None
    }
    sections = ("training", "identify", "velocity", "evaluation")
    named = {f"{key}.views": getattr(settings, key).views for key in sections if rendered}
    named |= {
        f"scenes.{name}.training.views": scene.training.get("views") for name, scene in rendered.items()
    }
    count = settings.dataset.dynamic.views
    for where, views in named.items():
        if wrong := [view for view in views or () if not 0 <= view < count]:
            yield f"{where}: no view {wrong[0]}. dataset.dynamic.views = {count}, which are numbered from 0"


def _experiment_problems(settings: Config) -> Iterator[str]:
    for name, experiment in settings.experiments.items():
        truth = settings.experiment_truth(name)
        if experiment.colliders is not None:
            yield from _mesh_problems(*settings.colliders(name))
        for k, (body, plain) in enumerate(zip(experiment.bodies, settings.experiment_bodies(name))):
            where = f"experiments.{name}.bodies.{k}"
            if body.shape is not None:
                yield from _start_problems(where, plain, truth.dt, truth.grid, *settings.colliders(name))
            if experiment.dt is not None and plain["law"] is not None:
                yield from _courant_problem(where, plain["law"], plain["density"], truth.grid, truth.dt)


def _start_problems(
    where: str,
    body: Mapping[str, Any],
    dt: float,
    grid: int,
    obstacles: str,
    colliders: Sequence[ColliderConfig],
) -> Iterator[str]:
    """Problems of the shape, the position and the motion that a body starts with."""
    shape = body["shape"]
    if is_mesh_file(shape):
        try:
            proportions = _mesh_proportions(shape)
        except InputError as error:
            yield f"{where}.shape: {error}"
            return
    elif shape in SHAPES or re.fullmatch(r"letter_[A-Z]", shape):
        proportions = SHAPES.get(shape, LETTER)
    else:
        yield f"{where}.shape: {shape!r} is unknown{hint(shape, [*SHAPES, 'letter_A'])}"
        return
    if missing := [key for key in ("height", "velocity", "law") if body[key] is None]:
        yield f"{where}: the scene of a capture or splat has no {', '.join(missing)}. Give it, or choose another scene"
        return
    size = body["size"] or proportions.size
    half = size * np.array(proportions.sides) / 2
    if any(body.get("rotation", ())):  # of the ellipsoid in the turned box, which the body about fills
        half = np.sqrt((rotation_matrix(body["rotation"]) ** 2) @ half**2)
    middle = np.array([body["center"][0], body["height"], body["center"][1]])
    for axis, key, low, high in zip("xyz", ("center", "height", "center"), middle - half, middle + half):
        if low < -ROUND_OFF or high > 1 + ROUND_OFF:
            wall = "below the floor at y = 0" if axis == "y" and low < 0 else "outside the box from 0 to 1 m"
            yield (
                f"{where}.{key}: the body extends from {axis} = {low:.3g} to {high:.3g} m, {wall}. Move it, or change "
                f"size = {size:g} m"
            )
    for k, collider in enumerate(colliders):
        if _contains(collider, middle):
            at = ", ".join(f"{coordinate:.3g}" for coordinate in middle)
            yield (
                f"{obstacles}.{k}: the {collider.shape} contains the centre [{at}] m of the body of {where}. Move one "
                "of the two"
            )
    reach = float(np.linalg.norm(half + size * np.abs(proportions.mass_centre)))
    yield from _speed_problem(where, body, reach, dt, grid)


def _contact_problems(settings: Config) -> Iterator[str]:
    """Scenes in whose videos not even the bounding box of the body touches a wall."""
    for name, scene in settings.scenes.items():
        if scene.has_truth and scene.shape in SHAPES and not scene.colliders:
            world, seconds = settings.scene_world(name), settings.frame_steps(name)[-1] * scene.dt
            size = scene.size or SHAPES[scene.shape].size
            middle, turned = flight(scene.plain(), size, world["gravity"], seconds)
            reach, zone = np.abs(turned).sum(axis=2), CONTACT_CELLS / world["grid"]
            if (middle - reach > zone).all() and (middle + reach < 1 - zone).all():
                yield (
                    f"scenes.{name}.steps: the body touches nothing in the {seconds:.3g} s of the video, so that no "
                    "method can learn its material. Use more steps, a larger velocity or a smaller height"
                )


def _speed_problem(where: str, body: Mapping[str, Any], reach: float, dt: float, grid: int) -> Iterator[str]:
    """The problem of a start so fast that it crosses a cell in a step, of a body that extends to ``reach`` [m]."""
    speed = math.hypot(*body["velocity"]) + math.hypot(*body["spin"]) * reach
    if speed * dt * grid >= 1:
        yield (
            f"{where}.velocity: at up to {speed:.3g} m/s a particle crosses a grid cell of {1 / grid:.3g} m in a time "
            f"step of {dt:g} s. Reduce velocity, spin or dt"
        )


def _contains(collider: ColliderConfig, point: np.ndarray) -> bool:
    """Whether a point [m] is inside a collider at t = 0. Meshes are checked when the truth is simulated."""
    centre, rotation = collider.start
    y = (point - np.array(centre)) @ rotation_matrix(rotation)
    size = np.array(collider.size)
    if collider.shape == "plane":
        return y[1] < 0
    if collider.shape == "box":
        return bool((np.abs(y) < size).all())
    half = size[0] if collider.shape == "capsule" else 0.0
    y[1] -= np.clip(y[1], -half, half)
    return not is_mesh_file(collider.shape) and bool(np.linalg.norm(y) < size[-1])


def _mesh_problems(where: str, colliders: Sequence[ColliderConfig]) -> Iterator[str]:
    """Files of the meshes of colliders that do not exist. They are read when the truth is simulated."""
    for k, collider in enumerate(colliders):
        if is_mesh_file(collider.shape) and not Path(collider.shape).is_file():
            yield f"{where}.{k}.shape: no file {collider.shape}. Give its path relative to the project's folder"


@cache
def _mesh_proportions(file: str) -> Proportions:
    """Proportions of the mesh in a file; the centre of its area stands for that of its mass."""
    from neuma_lib.io.mesh_files import read_any_mesh

    mesh = read_any_mesh(file)
    size = float(mesh.extents.max())
    centre = (mesh.centroid - mesh.bounds.mean(axis=0)) / size
    return Proportions(size, tuple(mesh.extents / size), tuple(centre), ("body",))


def _courant_problem(
    where: str, spec: Mapping[str, Any], density: Any, grid: int, dt: float
) -> Iterator[str]:
    """The problem of a time step that is unstable for a law; none for a law that `law_problems` reports, or whose
    modulus is unknown here because it is not built in."""
    law, _ = _checked(where, spec, dt)
    if law is None or ("elasticity", law["elasticity"]["name"]) in DEFINED_IN:
        return
    rho = min(density["below"], density["above"]) if isinstance(density, Mapping) else density
    modulus = longitudinal_modulus(law["elasticity"])
    if "viscosity" in law:
        modulus += viscous_stiffness(law["viscosity"])
    number = math.sqrt(stiffest(law.get("field")) * modulus / rho) * dt * grid
    if number > COURANT_LIMIT:
        yield (
            f"{where}: the Courant number {number:.3g} exceeds {COURANT_LIMIT} with dt = {dt:g} s and {grid} grid "
            f"cells. The largest stable step is {dt * COURANT_LIMIT / number:.3g} s"
        )


def _device_problems(device: str) -> Iterator[str]:
    if device == "cuda" and gpus() == 0:
        yield "device: cuda is set, but the machine has no CUDA GPU or driver. Set device: cpu or auto"
    if device == "cuda" and torch_version().endswith("+cpu"):
        yield f"device: cuda is set, but torch {torch_version()} is a CPU build. Install one with CUDA support"


def gpus() -> int:
    """How many GPUs the CUDA driver reports, 0 without a driver."""
    for library in ("libcuda.so.1", "nvcuda.dll"):
        try:
            driver, count = ctypes.CDLL(library), ctypes.c_int(0)
        except OSError:
            continue
        if driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0:
            return count.value
    return 0


def torch_version() -> str:
    """Version of the installed torch, for example ``2.13.0+cpu``; empty without one."""
    try:
        return importlib.metadata.version("torch")
    except importlib.metadata.PackageNotFoundError:
        return ""


def summary(settings: Config, files: Sequence[str | Path]) -> str:
    """What was checked, in one line."""
    laws = len({where for where, _ in _laws(settings)})
    counts = f"{len(settings.scenes)} scenes, {laws} laws, {len(settings.experiments)} experiments"
    return f"{', '.join(map(str, files))}: no problems ({counts}, device {settings.device})"
