"""Registration of a photographed object to its video: pose, velocity and spin at the start of a free flight.

The object is rigid in flight. Its initial position is approximately known from the parabola of the mask centres, its
rotation is unknown. Evenly distributed rotations are rendered in small pictures, each shifted to match the centroids of
the masks. The best ones are refined on an increasing number of frames at increasing resolution, and the worst are
dropped (`STAGES`). The refinement is Levenberg-Marquardt on all pixels of all cameras with the unknowns pose, velocity,
spin, time offsets of the cameras, and, as in `velocity`, an enlargement of the rendered body. Gravity is fixed, and
fitted in the end as a check.

If another pose explains the video nearly as well, the pose is ambiguous, which is reported but not an error. A ball
without texture has no defined rotation, and a symmetric bottle none about its axis.
"""

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
    FittedPose,
    Problem,
    difference,
    picture_times,
    render,
)
from neuma_lib.capture.registration.registered import Registration
from neuma_lib.capture.registration.rigid_motion import (
    RigidMotion,
    angle_between,
    moment_of_inertia,
    spread_rotations,
)
from neuma_lib.capture.registration.rigid_views import Agreement, Body, Pictures, Sight
from neuma_lib.errors import InputError
from neuma_lib.fitting.frame_batches import spread_frames
from neuma_lib.fitting.least_squares import BLOCKS, MIN_COST, jackknife, levenberg_marquardt
from neuma_lib.splatting.gaussians import Gaussians

# Initial rotations in addition to that of the photographs. Every rotation is within 25 degrees of one of them.
_GRID = 600
_DISTINCT = np.radians(15)  # minimum angle between distinct rotations
_MIN_IOU = 0.8  # mean, of masks and rendered silhouettes
# Squared spin in standard deviations up to which it is set to 0: 99th percentile of chi-squared with three degrees of
# freedom.
_MAX_NO_SPIN = 11.3
_MIN_FRAMES = 4  # of a camera that are kept above the floor
_COMPARISONS = 3  # pictures of each camera that the result contains with their renders
_ACROSS = 24  # diameter of the object in the pictures of the search [px]
_STARTS = 24  # number of rotations of the grid that are refined
_FIRST_WEIGHT, _MIN_WEIGHT = 0.5, 0.1  # initial and minimum weight of colours relative to coverage
_HOPELESS = 4.0  # cost relative to the best pose, on all frames, above which a pose is dropped


class Stage(NamedTuple):
    """A stage of the refinement."""

    across: float  # diameter of the object [px]
    reach: float  # time from the start that is compared, in frame intervals of the first camera
    frames: int  # maximum number of evenly spaced frames per camera
    free: tuple[int, ...] | None  # indices of the fitted unknowns, None for all
    kept: int  # number of distinct poses for the next stage
    iterations: int  # maximum number of steps
    central: bool  # whether to use central differences


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
    """Initial estimate of a flight."""

    time: float  # of the other values, by the clock of the first camera [s]
    # place, velocity: of the mask centres [m], [m/s], (3,)
    place: np.ndarray
    velocity: np.ndarray
    gravity: np.ndarray  # [m/s^2], (3,)
    spin: np.ndarray | None = None  # [rad/s], (3,). None if unknown.

    def at(self, time: float) -> "Parabola":
        """The same flight at another reference time."""
        t = time - self.time
        place = self.place + self.velocity * t + self.gravity * t**2 / 2
        return replace(self, time=time, place=place, velocity=self.velocity + self.gravity * t)


def first_common(sights: Sequence[Sight], name: str) -> float:
    """Time of the first frame of the first camera in the flights of all cameras [s]. Raises InputError if none."""
    begin, end = max(sight.clock[0] for sight in sights), min(sight.clock[-1] for sight in sights)
    clock = sights[0].clock
    common = clock[clock >= begin - np.diff(clock).min() / 2] if len(clock) > 1 else clock
    if len(common) == 0 or common[0] > end:
        raise InputError(
            name,
            "no part of the flight is visible to all cameras at once",
            "Check the time offsets of the cameras, and that the videos show the same take",
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
    start: float | None = None,
) -> Registration:
    """Estimate pose and motion of a photographed object in its video.

    Args:
        gaussians: of the photographed object.
        particles, mass: of the object, (N, 3) [m] and (N,), for centre of mass and moment of inertia.
        sights: frames of free flight of each camera in the unit of the Gaussians. The first camera defines the time.
        parabola: of the mask centres.
        name: of the take for messages.
        scale_known: whether photographs and video have the same scale. Otherwise the size is fitted, which must be
            correct within a factor of about 1.5.
        progress: called with (step, steps, root mean square residual).
        floor: height [m]. Frames in which the object would be below it, after the contact, are omitted. None: no floor.
        start: time of the pose [s], when several bodies are all in flight. None: `first_common`.

    Raises:
        InputError: the cameras have no common time, or it ends before ``start``. `check_overlap` refuses an object that
            matches in no pose.
    """
    start = first_common(sights, name) if start is None else start
    early = start - min(sight.clock[-1] for sight in sights)
    if early > 0:
        problem = f"its free flight ends {1000 * early:.0f} ms before that of another body begins"
        raise InputError(name, problem, "Release the bodies at the same time")
    parabola = parabola.at(start)
    pivot = mass @ particles / mass.sum()
    inertia = moment_of_inertia(particles - pivot, mass)
    body = Body.about(gaussians, pivot)
    distances = [s.viewmat[2, :3] @ parabola.place + s.viewmat[2, 3] for s in sights]
    if min(distances) <= 0:
        raise InputError(name, "the flight is behind a camera, so the pose of that camera is wrong")
    spin = np.zeros(3) if parabola.spin is None else parabola.spin
    motion = RigidMotion(np.eye(3), parabola.place, parabola.velocity, spin, parabola.gravity, inertia)
    offsets = np.array([sight.offset for sight in sights])
    fitted = [k for k in range(1, len(sights)) if not sights[k].offset_known]
    size = LIKELY_SIZE if scale_known else ANY_SIZE
    nothing = FittedPose(motion, offsets, 0.0, np.ones((len(sights), 3)))

    interval = float(np.median(np.diff(sights[0].times))) if len(sights[0].times) > 1 else 1.0
    candidates: list[FittedPose] = []
    others: list[tuple[float, FittedPose]] = []
    weights = np.full(len(sights), _FIRST_WEIGHT)
    for number, stage in enumerate(STAGES):
        flying = sights
        if floor is not None and stage.reach == np.inf:
            arms = particles - pivot
            flying = [_above_floor(s, arms, candidates[0], k, start, floor) for k, s in enumerate(sights)]
        chosen = [sight.select(_near_frames(sight.clock - start, stage, interval)) for sight in flying]
        pictures = Pictures(body, chosen, stage.across, distances)
        pictures.weights = weights
        if number == 0:
            candidates = _search(pictures, nothing, start, scale_known)
        refined = []
        for k, candidate in enumerate(candidates):
            refined.append(_refine(Problem(pictures, candidate, start, fitted, size), stage))
            if progress:
                done = (number * 100 + 100 * (k + 1) // len(candidates), len(STAGES) * 100)
                progress(*done, float(np.sqrt(refined[-1].cost / pictures.covered)))
        candidates, dropped = _distinct(refined, stage.kept)
        if 0 < number < len(STAGES) - 1:
            pictures.gains = candidates[0].gains.copy()
            ratios = pictures.residual_ratio(render(pictures, candidates[0], start))
            weights = np.clip(ratios, _MIN_WEIGHT, 1.0)
        if stage.reach == np.inf:
            best = max(candidates[0].cost, MIN_COST)
            going = [f for f in candidates if f.cost < _HOPELESS * best and stage is not STAGES[-1]]
            others += [(f.cost / best, f) for f in candidates[len(going) :] + dropped]
            candidates = going or candidates[:1]
    best = candidates[0]
    problem = Problem(pictures, best, start, fitted, size)
    covariance = _covariance(problem)
    spin, inverse = best.motion.spin, np.linalg.pinv(covariance[SPIN, SPIN])
    significant = bool(spin @ inverse @ spin > _MAX_NO_SPIN)
    if not significant:
        still = replace(best, motion=replace(best.motion, spin=np.zeros(3)))
        places = set(range(problem.size)) - set(range(*SPIN.indices(problem.size)))
        problem = Problem(pictures, still, start, fitted, size)
        best = _refine(problem, STAGES[-1]._replace(free=tuple(sorted(places & set(problem.all)))))
    view = sights[0].viewmat[2, :3] if len(sights) == 1 else None
    gravity, gravity_covariance = _gravity(pictures, best, start, fitted, size, view)
    others = [(ratio, other) for ratio, other in others if _angle(best, other) >= _DISTINCT]
    covariance += _spread(best, others)
    ratio, other = min(others, key=lambda each: each[0], default=(None, None))
    before = replace(best, motion=motion, enlargement=0.0)
    return Registration(
        names=tuple(sight.name for sight in sights),
        start=start,
        pivot=pivot,
        scale_known=scale_known,
        pose=best,
        covariance=covariance,
        gravity=gravity,
        gravity_covariance=gravity_covariance,
        before=_agreement(pictures, before, start),
        after=_agreement(pictures, best, start),
        rival=None if other is None else (ratio, float(np.degrees(_angle(best, other)))),
        spin_significant=significant,
        pictures=(len(pictures), pictures.side),
        axes=sights[0].viewmat[:3, :3],
        comparisons=pictures.comparisons(render(pictures, best, start), _COMPARISONS),
    )


def _near_frames(times: np.ndarray, stage: Stage, interval: float) -> np.ndarray:
    """Indices of the frames of a camera in a stage, at least one, from their times relative to the start [s]."""
    near = np.flatnonzero(np.abs(times) <= stage.reach * interval)
    if len(near) == 0 or stage.frames == 1:
        return np.array([np.abs(times).argmin()])
    return near[spread_frames(len(near), stage.frames)]


def _above_floor(
    sight: Sight, arms: np.ndarray, pose: FittedPose, camera: int, start: float, floor: float
) -> Sight:
    """Frames before particles at ``arms`` (N, 3) [m] from the centre reach the floor, at least `_MIN_FRAMES`."""
    times = sight.times + pose.offsets[camera] - start
    centres, _ = pose.motion.place(times)
    turns, _ = pose.motion.turn(times)
    lowest = (1 + pose.enlargement) * np.einsum("tj,nj->tn", turns[:, 1], arms).min(axis=1) + centres[:, 1]
    after = np.flatnonzero((lowest < floor) & (times > 0))
    before = after[0] if len(after) else len(times)
    return sight.select(range(max(before, min(_MIN_FRAMES, len(times)))))


def _search(pictures: Pictures, nothing: FittedPose, start: float, scale_known: bool) -> list[FittedPose]:
    """The best rotations of a grid, with positions from the centroids of the masks.

    If the scale is unknown, the size is estimated from the mean area of the masks.
    """
    motion, times = nothing.motion, picture_times(pictures, nothing, start)
    grid = np.concatenate([np.eye(3)[None], spread_rotations(_GRID)])
    centres, _ = motion.place(times)
    turns = Rotation.from_rotvec(times[:, None] * motion.spin).as_matrix()
    rotations = (turns @ grid[:, None]).reshape(-1, 3, 3)
    picture = np.tile(np.arange(len(times)), len(grid))
    every = np.tile(centres, (len(grid), 1))
    renders, enlargement = pictures.render(rotations, every, picture), 0.0
    observed, observed_area = pictures.moments()
    rendered, area = pictures.moments(renders, picture)
    if not scale_known:
        enlargement = float(np.sqrt(observed_area.mean() / area.mean())) - 1
        renders = pictures.render(rotations, every, picture, enlargement)
        rendered, area = pictures.moments(renders, picture)
    pictures.fit_gains(renders, grey=True)
    off = (observed[picture] - rendered).reshape(len(grid), -1, 2)
    ratio = (observed_area[picture] / np.maximum(area, 1e-9)).reshape(len(grid), -1)
    shifts = pictures.shifts(np.nan_to_num(off), ratio, centres, np.arange(len(times)))
    at = (centres + shifts[:, None]).reshape(-1, 3)
    costs = pictures.residuals(pictures.render(rotations, at, picture, enlargement), picture)[1].numpy()
    costs = costs.reshape(len(grid), -1).sum(axis=1)
    same = replace(nothing, enlargement=enlargement, gains=pictures.gains.copy())
    candidates = []
    for k in np.argsort(costs)[:_STARTS]:
        moved = replace(motion, rotation=grid[k], centre=motion.centre + shifts[k])
        candidates.append(replace(same, motion=moved, cost=float(costs[k])))
    return candidates


def _refine(problem: Problem, stage: Stage) -> FittedPose:
    """Refine the initial pose of a problem and fit the gains."""
    pictures, u = problem.pictures, problem.start
    pose = (*_POSE, SIZE) if problem.units[SIZE] == ANY_SIZE else _POSE
    free = [k for k in problem.all if stage.free is None or k in stage.free or k in pose]
    problem.central = stage.central
    min_gain = 1e-5 if stage.central else 1e-3
    for _ in range(2 if stage.central else 1):
        u, fit, _ = levenberg_marquardt(
            problem, u, free, problem.penalty, min_gain, stage.iterations, longest=0.3
        )
        pose = problem.pose(u)
        pictures.fit_gains(render(pictures, pose, problem.time))
    return replace(pose, gains=pictures.gains.copy(), cost=fit.cost)


def _angle(a: FittedPose, b: FittedPose) -> float:
    """Angle between two poses [rad]."""
    return float(angle_between(a.motion.rotation, b.motion.rotation)[0])


def _distinct(poses: Sequence[FittedPose], count: int) -> tuple[list[FittedPose], list[FittedPose]]:
    """The best ``count`` poses that are distinct from all better ones, and the other distinct poses, best first."""
    kept: list[FittedPose] = []
    for each in sorted(poses, key=lambda f: f.cost):
        if all(_angle(each, k) >= _DISTINCT for k in kept):
            kept.append(each)
    return kept[:count], kept[count:]


def _gravity(
    pictures: Pictures,
    best: FittedPose,
    start: float,
    fitted: Sequence[int],
    size: float,
    view: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Gravity (3,) and its covariance (3, 3), fitted together with all other unknowns.

    Args:
        view: viewing direction of a single camera, along which gravity is fixed because motion is hardly visible.
    """
    falling = np.eye(3)
    if view is not None:
        down = best.motion.gravity / np.linalg.norm(best.motion.gravity)
        side = np.cross(down, view)
        falling = np.stack([down, side / np.linalg.norm(side)])
    free = _refine(Problem(pictures, best, start, fitted, size, falling), STAGES[-1])
    spread = _covariance(Problem(pictures, free, start, fitted, size, falling))[GRAVITY, GRAVITY]
    spread = spread[: len(falling), : len(falling)]
    return free.motion.gravity, falling.T @ spread @ falling


def _covariance(problem: Problem) -> np.ndarray:
    """Block jackknife covariance of all unknowns in SI units, 0 for those not fitted.

    It includes the uncertainty of the prior for unknowns that the pictures do not determine.
    """
    problem.central = True
    full = problem.linearise(problem.start, problem.all)
    free = np.array(problem.all)
    fit = replace(full, curvatures=full.curvatures[:, free[:, None], free], scores=full.scores[:, free])
    P = problem.penalty(full)[free[:, None], free]
    covariance = np.zeros((problem.size, problem.size))
    prior = (np.linalg.pinv(fit.curvature + P) @ P)[:, np.diag(P) > 0]
    covariance[free[:, None], free] = jackknife(fit, P) + prior @ prior.T
    return covariance * np.outer(problem.units, problem.units)


def _spread(best: FittedPose, others: Sequence[tuple[float, FittedPose]]) -> np.ndarray:
    """Covariance from other poses, weighted by their likelihoods with the residuals of a block counted as one.

    Args:
        others: relative costs and poses.
    """
    weights = np.exp([-(ratio - 1) * BLOCKS**2 / 2 for ratio, _ in others])
    d = np.array([difference(best, other) for _, other in others]).reshape(len(others), -1)
    added = np.einsum("n,ni,nj->ij", weights, d, d) / (1 + weights.sum())
    return added if len(others) else 0.0


def _agreement(pictures: Pictures, pose: FittedPose, start: float) -> Agreement:
    pictures.gains, pictures.weights = pose.gains.copy(), np.ones(pictures.cameras)
    renders = render(pictures, pose, start)
    return pictures.agreement(renders, pictures.residuals(renders)[1].numpy())


def check_overlap(result: Registration, name: str) -> None:
    """Raises InputError if the object does not match the masks of the video in its best pose."""
    iou = result.after.iou.mean()
    if iou < _MIN_IOU:
        size = 100 * result.pose.enlargement
        raise InputError(
            name,
            "in the best pose the photographed object matches the masks of the video with an IoU of "
            f"{iou:.2f} < {_MIN_IOU} (size {size:+.0f} %). Possible causes: the video shows another object; "
            "photographs and video differ in scale (another position or print of the board); the shape has changed "
            "(soft, folded, opened); or masks of the photographs or of this take are wrong",
            "Check the contact sheets of the masks",
        )
