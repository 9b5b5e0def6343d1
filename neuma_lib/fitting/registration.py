"""Where a photographed object is in its video: its pose at the start of a free flight, its velocity and its spin.

The object has been photographed in a pose of its own, and in flight it is rigid. The place at the start is known
roughly from the parabola of the masks' centres; nothing is known of the rotation. So rotations that lie evenly in all
of them are rendered as small pictures, each moved to where its outline has the centroids of the masks; the best ones
are refined on a few frames, then on more and more frames of the flight, in finer and finer pictures, and the worst are
left behind (`STAGES`). The refinement is Levenberg and Marquardt's on all pixels of all cameras at once: pose,
velocity, spin, the time between cameras, and, as in `velocity`, an enlargement of the rendered body, since what is
rendered one percent too large looks one percent too near. Gravity is known there; freed at last, it is measured.

A pose that another explains nearly as well is ambiguous. That is said and not an error: a plain ball has no rotation, a
plain bottle none about its axis, and the deviations of such directions are large.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from neuma_lib.errors import InputError
from neuma_lib.fitting.frame_batches import spread_frames
from neuma_lib.fitting.least_squares import BLOCKS, LEAST_COST, Linearisation, jackknife, levenberg_marquardt
from neuma_lib.fitting.rigid_motion import (
    RigidMotion,
    angle_between,
    moment_of_inertia,
    spread_rotations,
    turned,
)
from neuma_lib.fitting.rigid_views import LOCAL, Body, Pictures, Shown, Sight
from neuma_lib.splatting.gaussians import Gaussians

GRID = 600
"""Rotations that are tried beside the one of the photographs: none is farther than 25 degrees from one of them."""
DISTINCT = np.radians(15)
"""Angle from which on two rotations are different ones."""
LEAST_IOU = 0.8
"""Mean IoU of masks and rendered outlines below which the object is not the one in the video."""
CLEAR_MARGIN = 0.25
"""Part of its cost by which the next distinct pose must be worse than the best one to be told from it: two standard
deviations if the residuals of a block of the picture count as one (`Linearisation.block_cost`)."""
CLEAR_ANGLE = 10.0
"""Largest standard deviation of a rotation [degrees] that is known."""
SPIN_SIGNIFICANCE = 11.3
"""Squared distance of the spin from 0, in standard deviations, below which there is none: one percent of chi-squared
variables with three degrees of freedom exceed it."""
LIKELY_SPIN = 10.0
"""Standard deviation of the spin of a dropped object [rad/s], before it is seen."""
LIKELY_SIZE, ANY_SIZE = 0.01, 0.3
"""Standard deviations of the relative size of its Gaussians, before: in metres, and in a world of unknown scale."""

FEWEST = 4
"""Frames of a camera that are kept, wherever the floor is."""
SHOWN = 3
"""Pictures of each camera that are shown beside their renders."""

_TURN, _PLACE, _VELOCITY, _SPIN, _SIZE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), 12
_GRAVITY, _OFFSETS = slice(13, 16), 16
_ANY_TURN = np.pi / np.sqrt(3)  # deviation of an angle that is not known at all [rad]
_UNITS = np.array([_ANY_TURN] * 3 + [0.1] * 3 + [1.0] * 3 + [LIKELY_SPIN] * 3)
_NO_DIRECTIONS = np.zeros((0, 3))
_GRAVITY_UNIT, _OFFSET_UNIT = 3.0, 0.01  # [m/s^2], [s]
_ACROSS = 24  # diameter of the object in the pictures of the search [px]
_STARTS = 24  # rotations of the grid that are refined
_FIRST_WEIGHT, _LEAST_WEIGHT = 0.5, 0.1  # of colours beside coverage: at first, and at least
_HOPELESS = 4.0  # times the cost of the best pose, all frames compared, from which on a pose is left behind


class Stage(NamedTuple):
    """A round of the refinement.

    Attributes:
        across: diameter of the object [px].
        reach: frame intervals of the first camera from the start that are compared.
        frames: most frames of a camera, spread evenly.
        free: places of the unknowns that are fitted; None: all.
        kept: distinct poses that go on to the next round.
        iterations: most steps.
        central: whether differences are central.
    """

    across: float
    reach: float
    frames: int
    free: tuple[int, ...] | None
    kept: int
    iterations: int
    central: bool


_POSE = (0, 1, 2, 3, 4, 5)
STAGES = (
    Stage(_ACROSS, 1, 1, _POSE, 6, 6, False),
    Stage(32, 4, 3, (*_POSE, 9, 10, 11), 6, 5, False),
    Stage(32, 10, 5, (*_POSE, 6, 7, 8, 9, 10, 11), 4, 5, False),
    Stage(48, np.inf, 8, None, 3, 8, False),
    Stage(96, np.inf, 12, None, 2, 12, True),
)


@dataclass(frozen=True, eq=False)
class Found:
    """A pose with what was fitted along.

    Attributes:
        motion: of the body.
        offsets: added to each camera's times [s], (cameras,).
        enlargement: of the rendered body.
        gains: of the cameras, (cameras, 3).
        cost: sum of squares of the round that it comes from.
    """

    motion: RigidMotion
    offsets: np.ndarray
    enlargement: float
    gains: np.ndarray
    cost: float = np.inf


@dataclass(frozen=True, eq=False)
class Agreement:
    """How a pose looks like what was seen, each of shape (pictures,).

    Attributes:
        camera: number of each picture's camera.
        iou: of mask and rendered outline.
        off: distance of their centroids, in pixels of the video.
        rms: root mean square of the residual of colours and coverage over the mask.
    """

    camera: np.ndarray
    iou: np.ndarray
    off: np.ndarray
    rms: np.ndarray


@dataclass(frozen=True, eq=False)
class Registration:
    """A photographed object placed into its video, x_video = s R x_photo + t at the time `start`.

    Attributes:
        names: of the cameras.
        start: the first frame of the flight that all cameras saw, by the first camera's clock [s].
        pivot: the centre of mass as photographed [m], (3,).
        scale_known: whether the photographs are in metres of the video, s = 1.
        found: pose and motion.
        covariance: of a turn about the world's axes [rad], the centre [m], velocity [m/s], spin [rad/s], enlargement,
            gravity [m/s^2] and the offsets of the cameras but the first [s], (15 + cameras,) squared; 0 for what was
            stated, as gravity is.
        gravity, gravity_covariance: the acceleration that the pictures show where it is fitted along [m/s^2], (3,) and
            (3, 3).
        before, after: agreement of the object as photographed, where the masks' centres are, and as placed.
        rival: cost of the next distinct pose relative to the best one's, and the angle between the two [degrees]; None:
            no other was left.
        spin_told: whether the spin is told from 0; it is 0 otherwise.
        pictures: number of pictures that were compared at last, and the size of a side of them [px].
        axes: rows are the first camera's right, down and viewing direction, (3, 3).
        shown: some pictures of each camera beside their renders.
    """

    names: tuple[str, ...]
    start: float
    pivot: np.ndarray
    scale_known: bool
    found: Found
    covariance: np.ndarray
    gravity: np.ndarray
    gravity_covariance: np.ndarray
    before: Agreement
    after: Agreement
    rival: tuple[float, float] | None
    spin_told: bool
    pictures: tuple[int, int]
    axes: np.ndarray
    shown: list[Shown]

    @property
    def rotation(self) -> np.ndarray:
        return self.found.motion.rotation

    @property
    def scale(self) -> float:
        return 1.0 if self.scale_known else 1.0 + self.found.enlargement

    @property
    def translation(self) -> np.ndarray:
        return self.found.motion.centre - self.scale * self.rotation @ self.pivot

    def place(self, x: np.ndarray) -> np.ndarray:
        """Points (N, 3) [m] of the object as photographed, in the video at the time `start`."""
        return self.scale * x @ self.rotation.T + self.translation

    @property
    def turn_deviations(self) -> np.ndarray:
        """Standard deviations of the rotation about its best and worst known axes [degrees], ascending, (3,)."""
        return np.degrees(np.sqrt(np.maximum(np.linalg.eigvalsh(self.covariance[_TURN, _TURN]), 0)))

    @property
    def ambiguous(self) -> str:
        """What is not told about the pose; nothing if all is."""
        said = []
        worst = self.turn_deviations[-1]
        if worst > CLEAR_ANGLE:
            values, vectors = np.linalg.eigh(self.covariance[_TURN, _TURN])
            count = int((np.degrees(np.sqrt(np.maximum(values, 0))) > CLEAR_ANGLE).sum())
            axis = ", ".join(f"{x:.2f}" for x in vectors[:, -1])
            about = (
                f"about the axis ({axis})" if count == 1 else f"about {('two axes', 'any axis')[count - 2]}"
            )
            said.append(f"the object looks alike when it is turned {about} (+-{worst:.0f} degrees)")
        if self.rival and self.rival[0] < 1 + CLEAR_MARGIN:
            said.append(
                f"a pose turned by {self.rival[1]:.0f} degrees explains the video nearly as well"
                f" (squared residual {self.rival[0]:.2f} times as large)"
            )
        return "; ".join(said)

    def deviations(self, part: slice, axes: np.ndarray | None = None) -> np.ndarray:
        """Standard deviations (3,) of a part of the unknowns, along the world's axes or others (3, 3)."""
        axes = np.eye(3) if axes is None else axes
        return np.sqrt(np.maximum(np.diag(axes @ self.covariance[part, part] @ axes.T), 0))

    def velocity(self) -> dict[str, Any]:
        """The initial motion, for velocity.json (`neuma_lib.fitting.throw.Throw.of`)."""
        motion = self.found.motion
        return {
            "v0": motion.velocity.tolist(),
            "angular_velocity": motion.spin.tolist(),
            "centre": motion.centre.tolist(),
            "units": {"v0": "m/s", "angular_velocity": "rad/s", "centre": "m"},
            "std": self.deviations(_VELOCITY).tolist(),
            "camera_axes": self.axes.tolist(),
            "std_camera": self.deviations(_VELOCITY, self.axes).tolist(),
            "angular_velocity_std": self.deviations(_SPIN).tolist(),
            "angular_velocity_std_camera": self.deviations(_SPIN, self.axes).tolist(),
        }

    def report(self) -> dict[str, Any]:
        """What is known, for people and later stages."""
        by_camera = {
            when: {
                name: {
                    "iou": float(found.iou[found.camera == k].mean()),
                    "least_iou": float(found.iou[found.camera == k].min()),
                    "centroid_px": float(found.off[found.camera == k].mean()),
                    "rms": float(np.sqrt(np.square(found.rms[found.camera == k]).mean())),
                }
                for k, name in enumerate(self.names)
            }
            for when, found in (("before", self.before), ("after", self.after))
        }
        offsets = np.zeros(len(self.names))
        offsets[1:] = np.sqrt(np.maximum(np.diag(self.covariance)[_OFFSETS:], 0))
        return {
            "t0_s": self.start,
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
            "scale": self.scale,
            "pivot": self.pivot.tolist(),
            "centre": self.found.motion.centre.tolist(),
            "turn_deg": float(np.degrees(Rotation.from_matrix(self.rotation).magnitude())),
            "rotation_std_deg": np.degrees(self.deviations(_TURN)).tolist(),
            "rotation_std_deg_principal": self.turn_deviations.tolist(),
            "centre_std": self.deviations(_PLACE).tolist(),
            "covariance": self.covariance.tolist(),
            "enlargement": self.found.enlargement,
            "enlargement_std": float(np.sqrt(max(self.covariance[_SIZE, _SIZE], 0))),
            "offsets_s": dict(zip(self.names, self.found.offsets.tolist())),
            "offsets_std_s": dict(zip(self.names, offsets.tolist())),
            "gains": dict(zip(self.names, self.found.gains.tolist())),
            "spin_told": self.spin_told,
            "rival": {"cost": self.rival[0], "angle_deg": self.rival[1]} if self.rival else None,
            "ambiguous": self.ambiguous,
            "pictures": self.pictures[0],
            "side_px": self.pictures[1],
            **by_camera,
            "units": {"translation": "m", "centre": "m"},
        }

    def summary(self) -> str:
        """A line for people."""
        motion, worst = self.found.motion, self.turn_deviations[-1]
        other = f"next pose {self.rival[0]:.2f} times the squared residual" if self.rival else "no other pose"
        return (
            f"turned by {np.degrees(Rotation.from_matrix(self.rotation).magnitude()):.1f} +- {worst:.1f} degrees,"
            f" placed within {1000 * self.deviations(_PLACE).max():.1f} mm; IoU {self.before.iou.mean():.3f} before,"
            f" {self.after.iou.mean():.3f} after; v0 ({', '.join(f'{x:+.3f}' for x in motion.velocity)}) +-"
            f" {self.deviations(_VELOCITY).max():.3f} m/s, spin ({', '.join(f'{x:+.2f}' for x in motion.spin)}) +-"
            f" {self.deviations(_SPIN).max():.2f} rad/s; {other}"
        )


@dataclass(frozen=True, eq=False)
class Parabola:
    """What is known of a flight before.

    Attributes:
        time: at which the rest is given, by the first camera's clock [s].
        place, velocity: of the masks' centre [m], [m/s], (3,).
        gravity: [m/s^2], (3,).
        spin: [rad/s], (3,); None: not known.
    """

    time: float
    place: np.ndarray
    velocity: np.ndarray
    gravity: np.ndarray
    spin: np.ndarray | None = None

    def at(self, time: float) -> Parabola:
        """The same flight, given at another time."""
        t = time - self.time
        return replace(
            self,
            time=time,
            place=self.place + self.velocity * t + self.gravity * t**2 / 2,
            velocity=self.velocity + self.gravity * t,
        )


def first_common(sights: Sequence[Sight], name: str) -> float:
    """Time of the first frame of the first camera that no camera's flight begins after [s].

    Raises:
        InputError: there is none.
    """
    begin, end = max(sight.clock[0] for sight in sights), min(sight.clock[-1] for sight in sights)
    clock = sights[0].clock
    common = clock[clock >= begin - np.diff(clock).min() / 2] if len(clock) > 1 else clock
    if len(common) == 0 or common[0] > end:
        raise InputError(
            f"{name}: no time of the flight was seen by all cameras: check the offsets between them, and that the"
            " videos show one throw"
        )
    return float(common[0])


def register(
    gaussians: Gaussians,
    particles: np.ndarray,
    mass: np.ndarray,
    sights: Sequence[Sight],
    parabola: Parabola,
    name: str,
    scale_known: bool = True,
    progress: Callable[[int, int, float], None] | None = None,
    floor: float | None = None,
) -> Registration:
    """Find pose and motion of a photographed object in its video.

    Args:
        gaussians: of the object as photographed.
        particles, mass: of the same, (N, 3) [m] and (N,); they tell the centre of mass and how the body tumbles.
        sights: frames of free flight of each camera, in metres of the Gaussians, the first of which keeps the time.
        parabola: of the masks' centres.
        name: of the throw, for messages.
        scale_known: whether photographs and video are in the same metres; otherwise the size is found along, if it is
            right within a factor of 1.5 or so.
        progress: called with (step, steps, root mean square residual).
        floor: height of it [m]; frames in which the placed object would reach below are those after the contact, and
            are left out. None: all frames are of free flight.

    Raises:
        InputError: no common time; or the object does not look like what was filmed, in any pose.
    """
    start = first_common(sights, name)
    parabola = parabola.at(start)
    pivot = mass @ particles / mass.sum()
    inertia = moment_of_inertia(particles - pivot, mass)
    body = Body.about(gaussians, pivot)
    distances = [s.viewmat[2, :3] @ parabola.place + s.viewmat[2, 3] for s in sights]
    if min(distances) <= 0:
        raise InputError(f"{name}: the flight lies behind a camera: its pose is wrong")
    spin = np.zeros(3) if parabola.spin is None else parabola.spin
    motion = RigidMotion(np.eye(3), parabola.place, parabola.velocity, spin, parabola.gravity, inertia)
    offsets = np.array([sight.offset for sight in sights])
    fitted = [k for k in range(1, len(sights)) if not sights[k].offset_known]
    size = LIKELY_SIZE if scale_known else ANY_SIZE
    nothing = Found(motion, offsets, 0.0, np.ones((len(sights), 3)))

    interval = float(np.median(np.diff(sights[0].times))) if len(sights[0].times) > 1 else 1.0
    candidates: list[Found] = []
    others: list[tuple[float, Found]] = []
    weights = np.full(len(sights), _FIRST_WEIGHT)
    for number, stage in enumerate(STAGES):
        flying = sights
        if floor is not None and stage.reach == np.inf:
            arms = particles - pivot
            flying = [_above(s, arms, candidates[0], k, start, floor) for k, s in enumerate(sights)]
        chosen = [sight.select(_near(sight.clock - start, stage, interval)) for sight in flying]
        pictures = Pictures(body, chosen, stage.across, distances)
        pictures.weights = weights
        if number == 0:
            candidates = _search(pictures, nothing, start, scale_known)
        refined = []
        for k, candidate in enumerate(candidates):
            refined.append(_refined(_Problem(pictures, candidate, start, fitted, size), stage))
            if progress:
                done = (number * 100 + 100 * (k + 1) // len(candidates), len(STAGES) * 100)
                progress(*done, float(np.sqrt(refined[-1].cost / pictures.covered)))
        candidates, dropped = _distinct(refined, stage.kept)
        if 0 < number < len(STAGES) - 1:
            weights = _colour_weights(pictures, candidates[0], start)
        if stage.reach == np.inf:
            best = max(candidates[0].cost, LEAST_COST)
            going = [f for f in candidates if f.cost < _HOPELESS * best and stage is not STAGES[-1]]
            others += [(f.cost / best, f) for f in candidates[len(going) :] + dropped]
            candidates = going or candidates[:1]
    best = candidates[0]
    problem = _Problem(pictures, best, start, fitted, size)
    covariance = _covariance(problem)
    spin, inverse = best.motion.spin, np.linalg.pinv(covariance[_SPIN, _SPIN])
    told = bool(spin @ inverse @ spin > SPIN_SIGNIFICANCE)
    if not told:
        still = replace(best, motion=replace(best.motion, spin=np.zeros(3)))
        places = set(range(problem.size)) - set(range(*_SPIN.indices(problem.size)))
        problem = _Problem(pictures, still, start, fitted, size)
        best = _refined(problem, STAGES[-1]._replace(free=tuple(sorted(places & set(problem.all)))))
    gravity, gravity_covariance = _gravity(
        pictures, best, start, fitted, size, sights[0].viewmat[2, :3] if len(sights) == 1 else None
    )
    others = [(ratio, other) for ratio, other in others if _apart(best, other) >= DISTINCT]
    covariance += _spread(best, others)
    ratio, other = min(others, key=lambda each: each[0], default=(None, None))
    before = replace(best, motion=motion, enlargement=0.0)
    found = Registration(
        names=tuple(sight.name for sight in sights),
        start=start,
        pivot=pivot,
        scale_known=scale_known,
        found=best,
        covariance=covariance,
        gravity=gravity,
        gravity_covariance=gravity_covariance,
        before=_agreement(pictures, before, start),
        after=_agreement(pictures, best, start),
        rival=None if other is None else (ratio, float(np.degrees(_apart(best, other)))),
        spin_told=told,
        pictures=(len(pictures), pictures.side),
        axes=sights[0].viewmat[:3, :3],
        shown=pictures.shown(_render(pictures, best, start), SHOWN),
    )
    _check(found, name)
    return found


class _Problem:
    """Residuals of pictures as a function of unknowns, in units of their own (`_UNITS`): a turn of the pose, changes of
    place and velocity, the spin, the enlargement, and changes of gravity and of the cameras' offsets but the first.

    Attributes:
        size: number of unknowns.
        all: places of those that are fitted.
        start: unknowns of what it begins with.
        falling: directions along which gravity is fitted, rows (K, 3); none: it is known.
    """

    def __init__(
        self,
        pictures: Pictures,
        begin: Found,
        time: float,
        fitted: Sequence[int],
        size: float = LIKELY_SIZE,
        falling: np.ndarray = _NO_DIRECTIONS,
    ):
        self.pictures, self.begin, self.time, self.falling = pictures, begin, time, falling
        cameras = len(begin.offsets)
        self.size = _OFFSETS + cameras - 1
        self.units = np.concatenate([_UNITS, [size], [_GRAVITY_UNIT] * 3, np.full(cameras - 1, _OFFSET_UNIT)])
        self.all = [*range(_GRAVITY.start + len(falling)), *(_OFFSETS + k - 1 for k in fitted)]
        self.start = np.zeros(self.size)
        self.start[_SPIN], self.start[_SIZE] = begin.motion.spin, begin.enlargement
        self.start /= self.units
        pictures.gains = begin.gains.copy()

    def found(self, unknowns: np.ndarray) -> Found:
        """What unknowns stand for."""
        u, begin = self.units * unknowns, self.begin
        motion = replace(
            begin.motion,
            rotation=Rotation.from_rotvec(u[_TURN]).as_matrix() @ begin.motion.rotation,
            centre=begin.motion.centre + u[_PLACE],
            velocity=begin.motion.velocity + u[_VELOCITY],
            spin=u[_SPIN],
            gravity=begin.motion.gravity + u[_GRAVITY][: len(self.falling)] @ self.falling,
        )
        offsets = begin.offsets + np.append(0.0, u[_OFFSETS:])
        return replace(begin, motion=motion, offsets=offsets, enlargement=float(u[_SIZE]))

    def cost(self, unknowns: np.ndarray) -> float:
        """Sum of squares."""
        return float(_costs(self.pictures, self.found(unknowns), self.time).sum())

    def linearise(self, unknowns: np.ndarray, free: Sequence[int], central: bool = False) -> Linearisation:
        """The problem around unknowns; columns that are not free are 0."""
        pictures, found = self.pictures, self.found(unknowns)
        times = _times(pictures, found, self.time)
        motion = found.motion
        centres, speeds = motion.place(times)
        rotations, spins = motion.turn(times)
        # How the pose in each picture, and the enlargement, depend on the unknowns: (pictures, 7, unknowns).
        G = np.zeros((len(times), LOCAL, self.size))
        G[:, :3, _TURN], G[:, :3, _SPIN] = self._turns(motion, times)
        G[:, 3:6, _PLACE], G[:, 3:6, _VELOCITY] = np.eye(3), times[:, None, None] * np.eye(3)
        G[:, 3:6, _GRAVITY][..., : len(self.falling)] = times[:, None, None] ** 2 / 2 * self.falling.T
        G[:, 6, _SIZE] = 1.0
        for camera in range(1, pictures.cameras):
            of = pictures.camera == camera
            G[of, :3, _OFFSETS + camera - 1], G[of, 3:6, _OFFSETS + camera - 1] = spins[of], speeds[of]
        held = np.setdiff1d(np.arange(self.size), free)
        G[..., held] = 0.0
        G *= self.units
        H, g, cost = pictures.normal_equations(rotations, centres, found.enlargement, central)
        curvatures = np.einsum("nia,nbij,njc->nbac", G, H, G)
        scores = np.einsum("nia,nbi->nba", G, g)
        # Blocks are those of a camera, over all its pictures.
        of = np.eye(pictures.cameras)[pictures.camera]
        curvatures, scores = (np.einsum("nc,nb...->cb...", of, each) for each in (curvatures, scores))
        total = float(cost.sum())
        rms = float(np.sqrt(total / pictures.covered))
        return Linearisation(
            curvatures.reshape(-1, self.size, self.size), scores.reshape(-1, self.size), total, rms
        )

    def penalty(self, fit: Linearisation) -> np.ndarray:
        """Curvature that holds turn, spin and enlargement at 0 +- 1: what nobody sees, stays likely."""
        held = np.zeros(self.size)
        held[[*range(3), *range(9, 12), _SIZE]] = fit.block_cost
        return np.diag(held)

    def _turns(self, motion: RigidMotion, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (T, 3, 3) of the rotations at times by a turn and by the spin at the time 0, by differences."""
        step = 1e-4
        small = Rotation.from_rotvec(step * np.concatenate([np.eye(3), -np.eye(3)])).as_matrix()
        stay = np.repeat(motion.rotation[None], 6, axis=0)
        spins = np.repeat(motion.spin[None], 6, axis=0)
        moved = spins + step * np.concatenate([np.eye(3), -np.eye(3)])
        turned_at, _ = turned(
            np.concatenate([small @ motion.rotation, stay]),
            np.concatenate([spins, moved]),
            motion.inertia,
            times,
        )
        change = turned_at.reshape(2, 2, 3, *turned_at.shape[1:])  # (turn or spin, side, axis, T, 3, 3)
        rotvecs = Rotation.from_matrix(
            (change[:, 0] @ np.swapaxes(change[:, 1], -1, -2)).reshape(-1, 3, 3)
        ).as_rotvec()
        by = rotvecs.reshape(2, 3, len(times), 3).transpose(0, 2, 3, 1) / (2 * step)
        return by[0], by[1]


class _Central:
    """A problem with central differences."""

    def __init__(self, problem: _Problem):
        self.cost, self._problem = problem.cost, problem

    def linearise(self, unknowns: np.ndarray, free: Sequence[int]) -> Linearisation:
        return self._problem.linearise(unknowns, free, central=True)


def _times(pictures: Pictures, found: Found, start: float) -> np.ndarray:
    return pictures.times + found.offsets[pictures.camera] - start


def _render(pictures: Pictures, found: Found, start: float) -> torch.Tensor:
    times = _times(pictures, found, start)
    poses = found.motion.turn(times)[0], found.motion.place(times)[0]
    return pictures.render(*poses, enlargement=found.enlargement)


def _costs(pictures: Pictures, found: Found, start: float) -> np.ndarray:
    """Cost of each picture, (N,)."""
    return pictures.residuals(_render(pictures, found, start))[1].numpy()


def _colour_weights(pictures: Pictures, found: Found, start: float) -> np.ndarray:
    """Weights of the colours beside coverage by how well they agree in a pose, (cameras,)."""
    pictures.gains = found.gains.copy()
    ratio = pictures.residual_ratio(_render(pictures, found, start))
    return np.clip(ratio, _LEAST_WEIGHT, 1.0)


def _near(times: np.ndarray, stage: Stage, interval: float) -> np.ndarray:
    """Indices of the frames of a camera that a stage compares, at least one; ``times`` from the start on [s]."""
    near = np.flatnonzero(np.abs(times) <= stage.reach * interval)
    if len(near) == 0 or stage.frames == 1:
        return np.array([np.abs(times).argmin()])
    return near[spread_frames(len(near), stage.frames)]


def _above(sight: Sight, arms: np.ndarray, found: Found, camera: int, start: float, floor: float) -> Sight:
    """A camera's frames before particles at ``arms`` (N, 3) [m] from the centre reach the floor, `FEWEST` at least."""
    times = sight.times + found.offsets[camera] - start
    centres, _ = found.motion.place(times)
    turns, _ = found.motion.turn(times)
    lowest = (1 + found.enlargement) * np.einsum("tj,nj->tn", turns[:, 1], arms).min(axis=1) + centres[:, 1]
    after = np.flatnonzero((lowest < floor) & (times > 0))
    before = after[0] if len(after) else len(times)
    return sight.select(range(max(before, min(FEWEST, len(times)))))


def _search(pictures: Pictures, nothing: Found, start: float, scale_known: bool) -> list[Found]:
    """The likeliest rotations of a grid, each placed by the centroids of the masks; if the scale is not known, with the
    size that their areas have in the mean."""
    motion, times = nothing.motion, _times(pictures, nothing, start)
    grid = np.concatenate([np.eye(3)[None], spread_rotations(GRID)])
    centres, _ = motion.place(times)
    turns = Rotation.from_rotvec(times[:, None] * motion.spin).as_matrix()
    rotations = (turns @ grid[:, None]).reshape(-1, 3, 3)
    picture = np.tile(np.arange(len(times)), len(grid))
    every = np.tile(centres, (len(grid), 1))
    renders, larger, (seen, seen_area) = pictures.render(rotations, every, picture), 0.0, pictures.moments()
    there, area = pictures.moments(renders, picture)
    if not scale_known:
        larger = float(np.sqrt(seen_area.mean() / area.mean())) - 1
        renders = pictures.render(rotations, every, picture, larger)
        there, area = pictures.moments(renders, picture)
    pictures.fit_gains(renders, grey=True)
    off = (seen[picture] - there).reshape(len(grid), -1, 2)
    ratio = (seen_area[picture] / np.maximum(area, 1e-9)).reshape(len(grid), -1)
    moved = pictures.shifts(np.nan_to_num(off), ratio, centres, np.arange(len(times)))
    at = (centres + moved[:, None]).reshape(-1, 3)
    costs = pictures.residuals(pictures.render(rotations, at, picture, larger), picture)[1].numpy()
    costs = costs.reshape(len(grid), -1).sum(axis=1)
    gains = pictures.gains.copy()
    return [
        replace(
            nothing,
            motion=replace(motion, rotation=grid[k], centre=motion.centre + moved[k]),
            enlargement=larger,
            gains=gains,
            cost=float(costs[k]),
        )
        for k in np.argsort(costs)[:_STARTS]
    ]


def _refined(problem: _Problem, stage: Stage) -> Found:
    """The best pose near what a problem begins with, and the gains there."""
    pictures, u = problem.pictures, problem.start
    pose = (*_POSE, _SIZE) if problem.units[_SIZE] == ANY_SIZE else _POSE
    free = [k for k in problem.all if stage.free is None or k in stage.free or k in pose]
    residuals = _Central(problem) if stage.central else problem
    for _ in range(2 if stage.central else 1):
        u, fit, _ = levenberg_marquardt(
            residuals,
            u,
            free,
            problem.penalty,
            1e-5 if stage.central else 1e-3,
            stage.iterations,
            longest=0.3,
        )
        found = problem.found(u)
        pictures.fit_gains(_render(pictures, found, problem.time))
    return replace(found, gains=pictures.gains.copy(), cost=fit.cost)


def _apart(a: Found, b: Found) -> float:
    """Angle between two poses [rad]."""
    return float(angle_between(a.motion.rotation, b.motion.rotation)[0])


def _distinct(found: Sequence[Found], count: int) -> tuple[list[Found], list[Found]]:
    """The best ``count`` poses that are `DISTINCT`, best first, and what else is distinct from all better ones."""
    kept: list[Found] = []
    for each in sorted(found, key=lambda f: f.cost):
        if all(_apart(each, k) >= DISTINCT for k in kept):
            kept.append(each)
    return kept[:count], kept[count:]


def _gravity(
    pictures: Pictures,
    best: Found,
    start: float,
    fitted: Sequence[int],
    size: float,
    view: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Acceleration (3,) and its covariance (3, 3), everything else fitted along.

    Args:
        view: direction of one camera alone, which hardly sees what happens along it: there gravity is taken as known.
    """
    falling = np.eye(3)
    if view is not None:
        down = best.motion.gravity / np.linalg.norm(best.motion.gravity)
        side = np.cross(down, view)
        falling = np.stack([down, side / np.linalg.norm(side)])
    free = _refined(_Problem(pictures, best, start, fitted, size, falling), STAGES[-1])
    spread = _covariance(_Problem(pictures, free, start, fitted, size, falling))[_GRAVITY, _GRAVITY]
    spread = spread[: len(falling), : len(falling)]
    return free.motion.gravity, falling.T @ spread @ falling


def _covariance(problem: _Problem) -> np.ndarray:
    """Covariance of all unknowns, by the jackknife over blocks of the pictures, in SI units; 0 for what was not fitted.

    Where what is likely holds an unknown that the pictures do not tell, the error of that is passed on.
    """
    full = problem.linearise(problem.start, problem.all, central=True)
    free = np.array(problem.all)
    fit = replace(full, curvatures=full.curvatures[:, free[:, None], free], scores=full.scores[:, free])
    P = problem.penalty(full)[free[:, None], free]
    covariance = np.zeros((problem.size, problem.size))
    prior = (np.linalg.pinv(fit.curvature + P) @ P)[:, np.diag(P) > 0]
    covariance[free[:, None], free] = jackknife(fit, P) + prior @ prior.T
    return covariance * np.outer(problem.units, problem.units)


def _spread(best: Found, others: Sequence[tuple[float, Found]]) -> np.ndarray:
    """What other poses, which explain the video nearly as well, add to the covariance of the best one: they are
    weighted by their likelihoods, residuals of a block of the picture counting as one.

    Args:
        others: cost relative to the best one's, and pose.
    """
    weights = np.exp([-(ratio - 1) * BLOCKS**2 / 2 for ratio, _ in others])
    moved = np.array([_difference(best, other) for _, other in others]).reshape(len(others), -1)
    added = np.einsum("n,ni,nj->ij", weights, moved, moved) / (1 + weights.sum())
    return added if len(others) else 0.0


def _difference(a: Found, b: Found) -> np.ndarray:
    """From one pose to another, in the unknowns."""
    p, q = a.motion, b.motion
    turn = Rotation.from_matrix(q.rotation @ p.rotation.T).as_rotvec()
    rest = [q.centre - p.centre, q.velocity - p.velocity, q.spin - p.spin, [b.enlargement - a.enlargement]]
    rest.append(q.gravity - p.gravity)
    return np.concatenate([turn, *rest, (b.offsets - a.offsets)[1:]])


def _agreement(pictures: Pictures, found: Found, start: float) -> Agreement:
    pictures.gains, pictures.weights = found.gains.copy(), np.ones(pictures.cameras)
    renders = _render(pictures, found, start)
    costs = pictures.residuals(renders)[1].numpy()
    return Agreement(pictures.camera.copy(), *pictures.agreement(renders, costs))


def _check(found: Registration, name: str) -> None:
    iou = found.after.iou.mean()
    if iou < LEAST_IOU:
        size = 100 * found.found.enlargement
        raise InputError(
            f"{name}: the photographed object does not look like the one in the video in any pose: its outline covers"
            f" the masks with an IoU of {iou:.2f} at best, {LEAST_IOU} is needed (size {size:+.0f} %). Likely causes:"
            " the videos show another object; photographs and videos differ in scale (the board was moved, or another"
            " print was laid); the object had another shape when it was photographed (soft, folded, opened); or masks"
            " are wrong, of the photographs or of this throw (look at their contact sheets)"
        )
