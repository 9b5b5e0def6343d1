"""Experiments that a lab could do next with an object: launch it, press it, hang it, or film it from elsewhere."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from neuma_lib.config.next import NextConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.colliders import Collider, contact_radius
from neuma_lib.sim.model import MPM, contact_clearance
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.rigid import moved
from neuma_lib.splatting.viewpoints import Views, framing, ring_directions, video_views

_MARGIN = 0.02  # minimum distance of the body from the walls at the start, as of random scenes [m]
_MOMENTS = 100  # times of a flight at which contact is tested
_BEFORE = (0.25, 1.5)  # duration of the flight over that after contact: the initial motion must be visible
_DURATION = 2.5  # of the longest press, in times that the existing video shows after the contact
# compression over the height of the body, and half the thickness of the platen [m]
_PRESSED, _PLATEN = (0.1, 0.45), 0.02
_CLAMPED = (0.15, 0.35)  # clamped part of the height of the body
_MIN_CLAMPED = 0.01  # of the particles
_STEPS = 32  # the steps of a video are a multiple of this, so that its frames are evenly spaced
_DRAWS = 50  # per candidate
_REST = {"velocity": [0.0, 0.0, 0.0], "spin": [0.0, 0.0, 0.0]}
_VIEWS = 5  # of the ring of a rendered scene, without the first
_AZIMUTHS, _ELEVATIONS = (45, 90, 135, -90), (0, 40)  # of a second camera from the first [degrees]
REJECTIONS = {
    "outside": "start outside the box",
    "early": "touch the floor before the initial motion can be seen",
    "late": "touch the floor too late or never",
    "wall": "touch another wall before the floor",
    "fast": "need a faster platen",
    "empty": "have too little of the body in the clamp",
}
"""Why a draw is rejected."""


@dataclass(frozen=True)
class Start:
    """The start of an experiment with the body."""

    # of its scene, in plain values. Colliders are in addition to those of the existing one.
    settings: dict[str, Any]
    model: MPM  # simulator constants, with its colliders and clamps
    body: Reconstruction  # the body at the start
    motion: InitialMotion  # its initial motion
    steps: int  # simulated steps of its video


def placed(body: Reconstruction, rotation: np.ndarray, centre: Sequence[float]) -> Reconstruction:
    """The body turned by a rotation (3, 3), with the bounding box of its particles about a centre (3,) [m]."""
    R = torch.from_numpy(np.asarray(rotation, dtype=np.float64))
    x = body.x0.double() @ R.to(body.x0.device).mT
    shift = torch.tensor(centre, dtype=torch.float64, device=x.device) - (x.amin(0) + x.amax(0)) / 2
    return replace(body, x0=(x + shift).to(body.x0), gaussians=moved(body.gaussians, R, shift))


def flight(
    model: MPM, body: Reconstruction, motion: InitialMotion, duration: float
) -> tuple[float, str | None]:
    """Time of the first contact of a rigid body [s], infinite if there is none in a duration [s], and the reason to
    reject it.

    Returns:
        The time, and "outside" or "wall" if the body starts outside the box or touches a wall before the floor.
    """
    x = body.x0.double().cpu().numpy()
    hull = x[ConvexHull(x).vertices]
    t = np.linspace(0, duration, _MOMENTS + 1)
    turns = Rotation.from_rotvec(t[:, None] * motion.spin).as_matrix()
    arms = np.einsum("tij,nj->tni", turns, hull - motion.centre)
    path = motion.centre + t[:, None] * motion.velocity + t[:, None] ** 2 / 2 * np.array(model.gravity)
    points = torch.from_numpy(path[:, None] + arms)
    vol0 = body.vol0.double().cpu().max().expand(len(hull))
    touching = (
        contact_clearance(model, points, vol0, np.round(t / model.dt).astype(int).tolist()) <= 0
    ).numpy()
    if (hull < _MARGIN).any() or (hull > 1 - _MARGIN).any():
        return math.inf, "outside"
    if not touching.any():
        return math.inf, None
    first = int(touching.argmax())
    low, high = points[first].amin(0), points[first].amax(0)
    floor = float(low[1]) <= min(float(low[0]), float(low[2]), *(1 - high).tolist())
    return float(t[first]), None if floor else "wall"


def draw_starts(
    model: MPM,
    body: Reconstruction,
    motion: InitialMotion,
    steps: int,
    lab: NextConfig,
    count: int,
    seed: int,
    kind: str = "launch",
) -> list[Start]:
    """Starts of a kind that the lab can do, spread evenly over their parameters, which are those of a Halton sequence.

    Args:
        model: simulator constants of the existing video.
        body: the body at the start of the existing video.
        motion: initial motion of the existing video, whose standard deviations the others have, too.
        steps: steps of its video.
        kind: one of `STARTS`.

    Raises:
        InputError: none is possible within the limits.
    """
    contact, _ = flight(model, body, motion, steps * model.dt)
    after = steps * model.dt - (contact if math.isfinite(contact) else 0.0)
    draws = qmc.Halton(10, seed=seed).random(_DRAWS * count)
    rejected: Counter[str] = Counter()
    starts: list[Start] = []
    model = replace(model, clamps=())
    for draw in draws:
        start = STARTS[kind](model, body, motion, after, lab, draw)
        if isinstance(start, str):
            rejected[start] += 1
        else:
            starts.append(start)
        if len(starts) == count:
            return starts
    if not starts:
        reasons = ", ".join(f"{number} {REJECTIONS[reason]}" for reason, number in rejected.most_common())
        problem = f"none of {len(draws)} experiments of the kind {kind} is possible inside the box: {reasons}"
        raise InputError("next", problem, "Raise next.max_height or next.max_speed, or leave the kind out")
    return starts


def _launch(
    model: MPM,
    body: Reconstruction,
    motion: InitialMotion,
    after: float,
    lab: NextConfig,
    draw: np.ndarray,
    turn: bool = False,
) -> Start | str:
    """The launch of a point of the unit cube (10,), or why it is rejected.

    The body lands in the middle of the box. The video shows as much time ``after`` the contact [s] as the existing one.
    """
    towards = _direction(draw[2], draw[3])
    towards[1] = -abs(towards[1])
    velocity = [_rounded(lab.max_speed * draw[0] * n) for n in towards]
    spin = [_rounded(lab.max_spin * draw[1] * n) for n in _direction(draw[4], draw[5])]
    if turn:
        turned = Rotation.from_rotvec(math.pi * draw[8] * _direction(draw[6], draw[7]))
    else:
        turned = Rotation.identity()
    rotation = [_rounded(angle) for angle in turned.as_rotvec()]
    R = Rotation.from_rotvec(rotation).as_matrix()
    size = np.ptp(body.x0.double().cpu().numpy() @ R.T, axis=0)
    lowest = size[1] / 2 + _MARGIN
    if lowest > lab.max_height:
        return "outside"
    height = _rounded(lowest + (lab.max_height - lowest) * draw[9])
    g, fall = -model.gravity[1], max(height - size[1] / 2, 0.0)
    time = (velocity[1] + math.sqrt(velocity[1] ** 2 + 2 * g * fall)) / g
    settings = {
        "height": height,
        "center": [_rounded(0.5 - velocity[axis] * time) for axis in (0, 2)],
        "velocity": velocity,
        "spin": spin,
        **({"rotation": rotation} if turn else {}),
    }
    return _landing(settings, model, body, motion, after, _BEFORE[1] * after, after)


def _press(
    model: MPM, body: Reconstruction, motion: InitialMotion, after: float, lab: NextConfig, draw: np.ndarray
) -> Start | str:
    """A press of a body that is let go just above the floor, by a platen that moves down and up again."""
    size = _size(body)
    radius, g = float(contact_radius(body.vol0).max()), -model.gravity[1]
    gap = max(radius + g * (1.1 * _BEFORE[0] * after) ** 2 / 2, 1.1 * _MARGIN)
    height, wait = _rounded(size[1] / 2 + gap), math.sqrt(2 * (gap - radius) / g)
    top, low = height + size[1] / 2 + _MARGIN + _PLATEN, size[1] * (1 - _between(_PRESSED, draw[0])) + _PLATEN
    if height > lab.max_height or top + _PLATEN > 1:
        return "outside"
    down = after * _between((0.25, 0.5 * _DURATION), draw[1])
    if top - low > lab.max_speed * down:
        return "fast"
    times = [_rounded(wait + k * down) for k in range(3)]
    poses = [
        [time, [0.5, _rounded(y), 0.5], [0.0, 0.0, 0.0]]
        for time, y in zip(times, (top, low, top), strict=True)
    ]
    widths = [_rounded(min(0.5 * size[axis] + 0.05, 0.48)) for axis in (0, 2)]
    platen = {"shape": "box", "size": [widths[0], _PLATEN, widths[1]], "keyframes": poses}
    settings = {"height": height, "center": [0.5, 0.5], **_REST, "colliders": [platen]}
    model = replace(model, contact="particles", colliders=(*model.colliders, Collider(**platen)))
    return _landing(settings, model, body, motion, after, wait + after, 2 * down)


def _landing(
    settings: dict[str, Any],
    model: MPM,
    body: Reconstruction,
    motion: InitialMotion,
    after: float,
    latest: float,
    shown: float,
) -> Start | str:
    """The start with some settings, or why it is rejected.

    Args:
        after: time after the contact in the existing video [s]. The initial motion must be visible for a part of it.
        latest: time of the first contact [s].
        shown: time that the video shows after the contact [s].
    """
    R = Rotation.from_rotvec(settings.get("rotation", (0.0, 0.0, 0.0))).as_matrix()
    own = placed(body, R, (settings["center"][0], settings["height"], settings["center"][1]))
    start = _moving(own, settings, motion.axes, motion.std)
    contact, reason = flight(model, own, start, latest)
    if reason or not math.isfinite(contact):
        return reason or "late"
    if contact < _BEFORE[0] * after:
        return "early"
    steps = _in_steps(model, contact + shown)
    return Start({**settings, "steps": steps}, model, own, start, steps)


def _hang(
    model: MPM, body: Reconstruction, motion: InitialMotion, after: float, lab: NextConfig, draw: np.ndarray
) -> Start | str:
    """A hang from a clamp around the upper part of the body, which moves to and fro and may then let go."""
    size = _size(body)
    lowest = size[1] / 2 + _MARGIN
    if lowest > lab.max_height:
        return "outside"
    height = _rounded(lowest + (lab.max_height - lowest) * draw[0])
    own = placed(body, np.eye(3), (0.5, height, 0.5))
    corner = [0.5 - size[0] / 2, height + size[1] * (0.5 - _between(_CLAMPED, draw[1])), 0.5 - size[2] / 2]
    opposite = [0.5 + size[0] / 2, height + size[1] / 2, 0.5 + size[2] / 2]
    clamp: dict[str, Any] = {
        "lowest": [_rounded(low - _MARGIN * (axis != 1)) for axis, low in enumerate(corner)],
        "highest": [_rounded(high + _MARGIN) for high in opposite],
    }
    time = _rounded(after * _between((0.1, 0.4), draw[2]))
    away = [_rounded(lab.max_speed * draw[3] * time * n) for n in _direction(draw[4], draw[5])]
    x = own.x0.double().cpu().numpy()
    reached = np.stack([x, x + away])
    if reached.min() < _MARGIN or reached.max() > 1 - _MARGIN:
        return "outside"
    still = [0.0, 0.0, 0.0]
    if any(away):
        clamp["keyframes"] = [[0.0, still, still], [time, away, still], [_rounded(2 * time), still, still]]
    if draw[6] < 0.5:
        clamp["release"] = _rounded(2 * time + after * draw[7] / 2)
    if (x[:, 1] >= clamp["lowest"][1]).mean() < _MIN_CLAMPED:
        return "empty"
    settings = {"height": height, "center": [0.5, 0.5], **_REST, "clamps": [clamp]}
    start = _moving(own, settings, motion.axes, np.zeros(6))
    steps = _in_steps(model, 2 * after)
    return Start({**settings, "steps": steps}, replace(model, clamps=(Clamp(**clamp),)), own, start, steps)


STARTS: dict[str, Callable[..., Start | str]] = {
    "launch": _launch,
    "turned": partial(_launch, turn=True),
    "press": _press,
    "hang": _hang,
}
"""Kinds of starts: functions of the existing video, the time that it shows after the contact [s], limits, and a point
of the unit cube (10,)."""


def _moving(
    body: Reconstruction, settings: Mapping[str, Any], axes: np.ndarray, std: np.ndarray
) -> InitialMotion:
    centre = (body.mass.double() @ body.x0.double() / body.mass.double().sum()).cpu().numpy()
    return InitialMotion(np.array(settings["velocity"]), np.array(settings["spin"]), centre, axes, std)


def _size(body: Reconstruction) -> np.ndarray:
    """Lengths of the bounding box of the particles (3,) [m]."""
    return np.ptp(body.x0.double().cpu().numpy(), axis=0)


def _in_steps(model: MPM, duration: float) -> int:
    return _STEPS * math.ceil(duration / model.dt / _STEPS)


def _between(limits: tuple[float, float], share: float) -> float:
    return limits[0] + (limits[1] - limits[0]) * share


def _direction(a: float, b: float) -> np.ndarray:
    """A uniformly distributed unit vector (Archimedes: its height is uniform)."""
    up, around = 2 * a - 1, 2 * math.pi * b
    flat = math.sqrt(max(0.0, 1 - up**2))
    return np.array([flat * math.cos(around), up, flat * math.sin(around)])


def _rounded(value: float) -> float:
    """Three significant digits, as a person would set them."""
    return float(f"{value:.3g}")


def second_cameras(
    cameras: Cameras, points: np.ndarray, rendered: bool
) -> list[tuple[dict[str, float], Cameras]]:
    """Places of a second camera that sees the same motion as the first one, with its image size.

    Args:
        cameras: of the existing video.
        points: positions of the body over all frames [m], shape (n, 3).
        rendered: whether the camera is one of the ring of a rendered scene (`viewpoints.ring_directions`), which has a
            number, ``view``.

    Returns:
        Azimuth and elevation from the line of sight of the first camera [degrees], and the camera.
    """
    back = -cameras.viewmats[0, 2, :3].double().cpu().numpy()
    start, rise = math.atan2(back[0], back[2]), math.asin(float(np.clip(back[1], -1, 1)))
    options: list[tuple[dict[str, float], Cameras]] = []
    if rendered:
        for view in range(1, 1 + _VIEWS):
            views = video_views(points, view + 1, cameras.width, cameras.height)
            x, y, z = ring_directions(view + 1)[view]
            azimuth = (math.degrees(math.atan2(x, z) - start) + 180) % 360 - 180
            place = {"view": view, "azimuth": azimuth, "elevation": math.degrees(math.asin(y) - rise)}
            own = as_cameras(views, cameras)[view]
            options.append(({key: round(value) for key, value in place.items()}, own))
        return options
    for elevation in _ELEVATIONS:
        for azimuth in _AZIMUTHS:
            at = start + math.radians(azimuth)
            up = min(rise + math.radians(elevation), math.radians(80))
            towards = [math.cos(up) * math.sin(at), math.sin(up), math.cos(up) * math.cos(at)]
            views = framing(np.array([towards]), points, cameras.width, cameras.height)
            options.append(({"azimuth": azimuth, "elevation": elevation}, as_cameras(views, cameras)))
    return options


def as_cameras(views: Views, like: Cameras) -> Cameras:
    """Views of `splatting.viewpoints` as cameras with the device and precision of others."""
    K = torch.from_numpy(np.repeat(views.K[None], len(views), axis=0))
    return Cameras(
        torch.from_numpy(views.viewmats).to(like.viewmats), K.to(like.Ks), views.width, views.height
    )
