"""Data of a viewer: Gaussians and particles of several motions of a scene, cameras and their images."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial import cKDTree
from torch import Tensor

from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.deformation import arms_at_rest, deform
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError
from neuma_lib.io.files import one_line, parse_json, read_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import read_image_set, read_transforms
from neuma_lib.io.particles import load_reconstruction
from neuma_lib.io.simulator import with_obstacles
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Law
from neuma_lib.project.files import RunFiles, SceneFiles
from neuma_lib.sim.colliders import Collider
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.viewer import scalars

TRUTH = "truth"
_BOUND = 8  # number of true particles bound to a Gaussian of the reconstruction

Log = Callable[[str], None]


@dataclass(frozen=True)
class Motion:
    """Motion of a body.

    Attributes:
        name: `TRUTH`, or that of a method.
        title: display name.
        steps: simulation step of each frame, length T.
        x: particles [m], shape (T, N, 3).
        scalars: name in `scalars.QUANTITIES` -> values of particles, shape (T, N); without unknown ones. With several
            bodies also ``body``: indices of the bodies.
        means, covars: Gaussians [m], [m^2], shapes (T, G, 3) and (T, G, 3, 3); None if none are bound to the particles.
    """

    name: str
    title: str
    steps: tuple[int, ...]
    x: Tensor
    scalars: dict[str, Tensor]
    means: Tensor | None
    covars: Tensor | None


@dataclass(frozen=True)
class View:
    """A camera: world to camera (4, 4) (OpenCV axes), intrinsics (3, 3) and size [px].

    ``images`` by step are straight-alpha RGBA, uint8, downsampled.
    """

    number: int
    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int
    images: dict[int, np.ndarray]


@dataclass(frozen=True)
class Scene:
    """All motions of a scene.

    Attributes:
        name: of the scene.
        dt: time step [s].
        gaussians: at rest; colours and opacities are the same in all motions.
        volume: of the body [m^3].
        motions: the true one first, if known.
        views: cameras.
        ranges: legend ranges by name, see `scalars.ranges`.
        notes: messages on missing content.
        colliders: obstacles.
        bodies: names of several bodies; (): one body.
    """

    name: str
    dt: float
    gaussians: Gaussians
    volume: float
    motions: tuple[Motion, ...]
    views: tuple[View, ...]
    ranges: dict[str, tuple[float, float]]
    notes: tuple[str, ...]
    colliders: tuple[Collider, ...] = ()
    bodies: tuple[str, ...] = ()

    @property
    def steps(self) -> tuple[int, ...]:
        """Steps of the frames on the slider: those of the motion with most frames."""
        return max((motion.steps for motion in self.motions), key=len)


def frame_at(steps: tuple[int, ...], step: int) -> int:
    """Index of the last frame at or before a step, or of the first frame."""
    return max(int(np.searchsorted(steps, step, side="right")) - 1, 0)


def load_scene(
    files: SceneFiles, log: Log = lambda text: None, side: int = 160, skip_damaged: bool = False
) -> Scene:
    """Read a scene and deform its Gaussians with every motion.

    Args:
        log: callback for progress messages.
        side: see `load_views`.
        skip_damaged: replace a damaged predicted motion by a note.

    Raises:
        InputError: a damaged file of the body or of a motion, or one outside the permitted folders
            (`SceneFiles.checked`).
    """
    paths = [files.checked(path) for path in (files.particles, files.binding, files.gaussians)]
    body, dt = load_reconstruction(*paths, files.density), files.simulation["dt"]
    listed = read_json(files.checked(files.velocity)).get("bodies", ()) if files.velocity else ()
    bodies = tuple(each.get("name", each["scene"]) for each in listed)
    counts = torch.tensor([each["particles"] for each in listed], dtype=torch.int64)
    owners = torch.arange(len(bodies)).repeat_interleave(counts)
    motions, notes = [], []
    if files.truth:
        motions.append(true_motion(files.checked(files.truth), body, dt))
    for run in files.runs:
        log(f"{run.title}: {run.rollout}")
        try:
            motions.append(_predicted(files, run, body, owners, notes))
        except InputError as error:
            if not skip_damaged:
                raise
            notes.append(f"{run.title} is left out: {one_line(error)}")
    titles = [motion.title for motion in motions]
    motions = [
        replace(motion, title=f"{motion.title} ({motion.name})") if titles.count(motion.title) > 1 else motion
        for motion in motions
    ]
    if not motions:
        command = f"snakemake --cores 2 results/{files.name}/<method>/rollout.h5"
        raise InputError(files.name, "has no motion", f"Compute one with `{command}`")
    views = ()
    if files.transforms:
        try:
            views = load_views(files, side)
        except InputError as error:
            notes.append(f"no cameras: {one_line(error)}")
    bounds, volume = scalars.ranges(motion.scalars for motion in motions), float(body.vol0.sum())
    colliders = with_obstacles(files.simulation).get("colliders", ())
    return Scene(
        files.name, dt, body.gaussians, volume, tuple(motions), views, bounds, tuple(notes), colliders, bodies
    )


def true_motion(path: Path, body: Reconstruction, dt: float) -> Motion:
    """The ground truth, with the fitted Gaussians of the reconstruction.

    Each Gaussian follows the affine motion of the `_BOUND` true particles that are nearest to it at the start.
    """
    names = ("x", "F", "v", "frames", "body")
    arrays, attributes = read_arrays(path, required=("x", "F"), only=names)
    law = None
    if "bodies" in attributes:
        bodies = parse_json(attributes["bodies"], path)
        simulation = parse_json(attributes.get("simulation", "{}"), path)
        if len(bodies) == 1:
            law = analytic_law(bodies[0]["law"], dt=simulation.get("dt", dt))
    x, F = (torch.from_numpy(arrays[name]) for name in ("x", "F"))
    v = torch.from_numpy(arrays["v"]) if "v" in arrays else None
    steps = _steps(arrays, len(x))
    g = body.gaussians
    binding = nearest_binding(g.means, x[0])
    moved = deform(g.means, g.covars(), binding, x[0], x, F, arms=arms_at_rest(g.means, binding, x[0]))
    values = _values(x, F, None, v, steps, dt, law)
    if "body" in arrays:
        values["body"] = torch.from_numpy(arrays["body"]).expand(len(x), -1)
    return Motion(TRUTH, "Truth", steps, x, values, *moved)


def nearest_binding(means: Tensor, x: Tensor) -> Binding:
    """Bind every Gaussian (G, 3) to its nearest particles of x (N, 3), with weights inverse to the distance."""
    count = min(_BOUND, len(x))
    distance, near = cKDTree(x.numpy()).query(means.numpy(), k=np.arange(1, count + 1))
    weights = 1 / np.maximum(distance, 1e-9)
    order = np.argsort(near, axis=1)
    near, weights = (np.take_along_axis(a, order, axis=1) for a in (near, weights))
    weights /= weights.sum(axis=1, keepdims=True)
    indptr = torch.arange(len(means) + 1) * count
    return Binding(
        indptr,
        torch.from_numpy(near.ravel().astype(np.int64)),
        torch.from_numpy(weights.ravel()).to(means),
        (len(means), len(x)),
    )


def _predicted(
    files: SceneFiles, run: RunFiles, body: Reconstruction, owners: Tensor, notes: list[str]
) -> Motion:
    """A method's motion on the reconstructed body, or bodies to which the particles belong (N,)."""
    path = files.checked(run.rollout)
    arrays, attributes = read_arrays(path, required=("x", "F"), only=("x", "F", "F_total", "frames"))
    x, F = (torch.from_numpy(arrays[name]) for name in ("x", "F"))
    total = torch.from_numpy(arrays["F_total"]) if "F_total" in arrays else None
    if not (x.isfinite().all() and F.isfinite().all()):
        raise InputError(path, "has values that are not finite", "Regenerate it")
    steps, dt = _steps(arrays, len(x)), float(attributes.get("dt", files.simulation["dt"]))
    law = None
    if run.law is None:
        notes.append(f"{run.title}: no stress, as its motion follows from no single law")
    else:
        try:
            law = run.law.load(files.checked).law
        except InputError as error:
            notes.append(f"{run.title}: no stress, as its law cannot be read ({one_line(error)})")
    means = covars = None
    stretch, g = F if total is None else total, body.gaussians
    at_rest = (g.means, g.covars())
    if x.shape[1] == len(body.x0):
        arms = arms_at_rest(g.means, body.binding, body.x0) if run.gaussian_motion == "affine" else None
        means, covars = deform(*at_rest, body.binding, body.x0, x, stretch, arms=arms)
    elif x.shape[1] == len(g):
        means, covars = deform(*at_rest, Binding.identity(len(g), g.means), g.means, x, stretch)
    else:
        notes.append(f"{run.title}: its own particles, which carry no Gaussians")
    # a law with another time step has other steps; the slider shows those of the scene
    scene_steps = tuple(round(step * dt / files.simulation["dt"]) for step in steps)
    values = _values(x, F, total, None, steps, dt, law)
    if x.shape[1] == len(owners):
        values["body"] = owners.expand(len(x), -1)
    return Motion(run.name, run.title, scene_steps, x, values, means, covars)


def _values(
    x: Tensor, F: Tensor, total: Tensor | None, v: Tensor | None, steps: tuple[int, ...], dt: float, law: Law | None
) -> dict[str, Tensor]:  # fmt: skip
    """All known scalars of a motion."""
    values = {
        "speed": scalars.speed(x, dt * torch.tensor(steps), v),
        "plastic_strain": scalars.plastic_strain(F, scalars.total_deformation(x) if total is None else total),
        "volume_ratio": scalars.volume_ratio(F),
    }
    if law is not None:
        factors = 1.0 if law.field is None else law.field.factors(x[0])
        values["von_mises"] = torch.stack([factors * scalars.von_mises(law, frame) for frame in F])
    return values


def _steps(arrays: dict[str, np.ndarray], count: int) -> tuple[int, ...]:
    return tuple(arrays["frames"].tolist()) if "frames" in arrays else tuple(range(count))


def load_views(files: SceneFiles, side: int = 160) -> tuple[View, ...]:
    """Cameras of a video with downsampled images.

    Args:
        side: longer side of the images [px].

    Raises:
        InputError: no such list, or an image that is damaged, missing or outside the permitted folders.
    """
    path = files.checked(files.transforms)
    listed = read_transforms(path)["frames"]
    for frame in listed:
        for name in (frame["file_path"], f"{frame['file_path']}.png"):
            if (path.parent / name).is_file():
                files.checked(path.parent / name)
    views = []
    for number in sorted({frame.get("view", i) for i, frame in enumerate(listed)}):
        full = read_image_set(path, [number])
        scale = min(1.0, side / max(full.width, full.height))
        size = max(1, round(full.width * scale)), max(1, round(full.height * scale))
        small = [Image.fromarray(image).resize(size, Image.Resampling.BOX) for image in full.images]
        images = {int(step): np.asarray(image) for step, image in zip(full.steps, small, strict=True)}
        views.append(View(number, full.viewmats[0], full.Ks[0], full.width, full.height, images))
    return tuple(views)
