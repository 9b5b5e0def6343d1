"""Experiments that a lab could do next with an object: other launches, and other cameras."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
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
from neuma_lib.sim.model import MPM, contact_clearance
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.rigid import moved
from neuma_lib.splatting.viewpoints import Views, framing, ring_directions, video_views

_MARGIN = 0.02  # minimum distance of the body from the walls at the start, as of random scenes [m]
_MOMENTS = 100  # times of a flight at which contact is tested
_BEFORE = (0.25, 1.5)  # duration of the flight over that after contact: the initial motion must be visible
_STEPS = 32  # the steps of a video are a multiple of this, so that its frames are evenly spaced
_DRAWS = 50  # per candidate
_VIEWS = 5  # of the ring of a rendered scene, without the first
_AZIMUTHS, _ELEVATIONS = (45, 90, 135, -90), (0, 40)  # of a second camera from the first [degrees]
REJECTIONS = {
    "outside": "start outside the box",
    "early": "touch the floor before the initial motion can be seen",
    "late": "touch the floor too late or never",
    "wall": "touch another wall before the floor",
}
"""Why a draw is rejected."""


@dataclass(frozen=True)
class Launch:
    """A launch of the body.

    Attributes:
        settings: of its scene, in plain values.
        body: the body at the start.
        motion: its initial motion.
        steps: simulated steps of its video.
    """

    settings: dict[str, Any]
    body: Reconstruction
    motion: InitialMotion
    steps: int


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


def draw_launches(
    model: MPM,
    body: Reconstruction,
    motion: InitialMotion,
    steps: int,
    lab: NextConfig,
    count: int,
    seed: int,
    turn: bool = False,
) -> list[Launch]:
    """Launches that the lab can do and that end in a contact with the floor, spread evenly over their parameters.

    Height, velocity, spin and orientation are those of a Halton sequence. The centre is such that the body lands in the
    middle of the box. Each video shows as much time after the contact as the existing one.

    Args:
        model: simulator constants.
        body: the body at the start of the existing launch.
        motion: initial motion of the existing launch, whose standard deviations the others have, too.
        steps: steps of its video.
        lab: limits.
        count: number of launches.
        seed: of the sequence.
        turn: whether the body may start in other orientations.

    Raises:
        InputError: no launch is possible within the limits.
    """
    contact, _ = flight(model, body, motion, steps * model.dt)
    after = steps * model.dt - (contact if math.isfinite(contact) else 0.0)
    draws = qmc.Halton(10, seed=seed).random(_DRAWS * count)
    rejected: Counter[str] = Counter()
    launches: list[Launch] = []
    for draw in draws:
        launch = _launch(model, body, motion, after, lab, draw, turn)
        if isinstance(launch, str):
            rejected[launch] += 1
        else:
            launches.append(launch)
        if len(launches) == count:
            return launches
    if not launches:
        counted = ", ".join(f"{number} {REJECTIONS[reason]}" for reason, number in rejected.most_common())
        problem = f"none of {len(draws)} launches is possible inside the box: {counted}"
        raise InputError("next", problem, "Raise next.max_height or next.max_speed")
    return launches


def _launch(
    model: MPM,
    body: Reconstruction,
    motion: InitialMotion,
    after: float,
    lab: NextConfig,
    draw: np.ndarray,
    turn: bool,
) -> Launch | str:
    """The launch of a point of the unit cube (10,), or why it is rejected."""
    towards = _direction(draw[2], draw[3])
    towards[1] = -abs(towards[1])
    velocity = [_rounded(lab.max_speed * draw[0] * n) for n in towards]
    spin = [_rounded(lab.max_spin * draw[1] * n) for n in _direction(draw[4], draw[5])]
    turned = (
        Rotation.from_rotvec(math.pi * draw[8] * _direction(draw[6], draw[7]))
        if turn
        else Rotation.identity()
    )
    rotation = [_rounded(angle) for angle in turned.as_rotvec()]
    R = Rotation.from_rotvec(rotation).as_matrix()
    size = np.ptp(body.x0.double().cpu().numpy() @ R.T, axis=0)
    lowest = size[1] / 2 + _MARGIN
    if lowest > lab.max_height:
        return "outside"
    height = _rounded(lowest + (lab.max_height - lowest) * draw[9])
    # The body lands in the middle of the box.
    g, fall = -model.gravity[1], max(height - size[1] / 2, 0.0)
    time = (velocity[1] + math.sqrt(velocity[1] ** 2 + 2 * g * fall)) / g
    center = [_rounded(0.5 - velocity[axis] * time) for axis in (0, 2)]
    own = placed(body, R, (center[0], height, center[1]))
    mass = own.mass.double() / own.mass.double().sum()
    start = InitialMotion(
        np.array(velocity), np.array(spin), (mass @ own.x0.double()).cpu().numpy(), motion.axes, motion.std
    )
    low, high = (after * share for share in _BEFORE)
    contact, reason = flight(model, own, start, high)
    if reason or not math.isfinite(contact):
        return reason or "late"
    if contact < low:
        return "early"
    steps = _STEPS * math.ceil((contact + after) / model.dt / _STEPS)
    settings = {"height": height, "center": center, "velocity": velocity, "spin": spin, "steps": steps}
    return Launch(settings | ({"rotation": rotation} if turn else {}), own, start, steps)


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
