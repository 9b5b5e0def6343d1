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
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from neuma_lib.capture.registration.problem import (
    ANY_SIZE,
    GRAVITY,
    LIKELY_SIZE,
    SIZE,
    SPIN,
    Central,
    Found,
    Problem,
    difference,
    picture_times,
    render,
)
from neuma_lib.capture.registration.registered import Agreement, Registration
from neuma_lib.capture.registration.rigid_motion import (
    RigidMotion,
    angle_between,
    moment_of_inertia,
    spread_rotations,
)
from neuma_lib.capture.registration.rigid_views import Body, Pictures, Sight
from neuma_lib.errors import InputError
from neuma_lib.fitting.frame_batches import spread_frames
from neuma_lib.fitting.least_squares import BLOCKS, MIN_COST, jackknife, levenberg_marquardt
from neuma_lib.splatting.gaussians import Gaussians

GRID = 600
"""Rotations that are tried beside the one of the photographs: none is farther than 25 degrees from one of them."""
DISTINCT = np.radians(15)
"""Angle from which on two rotations are different ones."""
LEAST_IOU = 0.8
"""Mean IoU of masks and rendered outlines below which the object is not the one in the video."""
SPIN_SIGNIFICANCE = 11.3
"""Squared distance of the spin from 0, in standard deviations, below which there is none: one percent of chi-squared
variables with three degrees of freedom exceed it."""

FEWEST = 4
"""Frames of a camera that are kept, wherever the floor is."""
SHOWN = 3
"""Pictures of each camera that are shown beside their renders."""

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
            refined.append(_refined(Problem(pictures, candidate, start, fitted, size), stage))
            if progress:
                done = (number * 100 + 100 * (k + 1) // len(candidates), len(STAGES) * 100)
                progress(*done, float(np.sqrt(refined[-1].cost / pictures.covered)))
        candidates, dropped = _distinct(refined, stage.kept)
        if 0 < number < len(STAGES) - 1:
            weights = _colour_weights(pictures, candidates[0], start)
        if stage.reach == np.inf:
            best = max(candidates[0].cost, MIN_COST)
            going = [f for f in candidates if f.cost < _HOPELESS * best and stage is not STAGES[-1]]
            others += [(f.cost / best, f) for f in candidates[len(going) :] + dropped]
            candidates = going or candidates[:1]
    best = candidates[0]
    problem = Problem(pictures, best, start, fitted, size)
    covariance = _covariance(problem)
    spin, inverse = best.motion.spin, np.linalg.pinv(covariance[SPIN, SPIN])
    told = bool(spin @ inverse @ spin > SPIN_SIGNIFICANCE)
    if not told:
        still = replace(best, motion=replace(best.motion, spin=np.zeros(3)))
        places = set(range(problem.size)) - set(range(*SPIN.indices(problem.size)))
        problem = Problem(pictures, still, start, fitted, size)
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
        shown=pictures.shown(render(pictures, best, start), SHOWN),
    )
    _check(found, name)
    return found


def _colour_weights(pictures: Pictures, found: Found, start: float) -> np.ndarray:
    """Weights of the colours beside coverage by how well they agree in a pose, (cameras,)."""
    pictures.gains = found.gains.copy()
    ratio = pictures.residual_ratio(render(pictures, found, start))
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
    motion, times = nothing.motion, picture_times(pictures, nothing, start)
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


def _refined(problem: Problem, stage: Stage) -> Found:
    """The best pose near what a problem begins with, and the gains there."""
    pictures, u = problem.pictures, problem.start
    pose = (*_POSE, SIZE) if problem.units[SIZE] == ANY_SIZE else _POSE
    free = [k for k in problem.all if stage.free is None or k in stage.free or k in pose]
    residuals = Central(problem) if stage.central else problem
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
        pictures.fit_gains(render(pictures, found, problem.time))
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
    free = _refined(Problem(pictures, best, start, fitted, size, falling), STAGES[-1])
    spread = _covariance(Problem(pictures, free, start, fitted, size, falling))[GRAVITY, GRAVITY]
    spread = spread[: len(falling), : len(falling)]
    return free.motion.gravity, falling.T @ spread @ falling


def _covariance(problem: Problem) -> np.ndarray:
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
    moved = np.array([difference(best, other) for _, other in others]).reshape(len(others), -1)
    added = np.einsum("n,ni,nj->ij", weights, moved, moved) / (1 + weights.sum())
    return added if len(others) else 0.0


def _agreement(pictures: Pictures, found: Found, start: float) -> Agreement:
    pictures.gains, pictures.weights = found.gains.copy(), np.ones(pictures.cameras)
    renders = render(pictures, found, start)
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
