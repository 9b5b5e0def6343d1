"""Identify the material shown in a video.

Fits the constants of every candidate family and selects the family with the lowest held-out error. The fit is
Levenberg-Marquardt through rollout and renderer, with a Jacobian of a few rollouts. It proceeds from coarse to fine
levels of an image pyramid, because the basin of convergence of sharp images is about a pixel. Constants are unbounded
logarithms or logits. A family is initialised from the best of its default guess, the scene's prior and the fits of
simpler families. Families whose loss exceeds ``prune_factor`` times the best are dropped.

The initial motion is estimated from the frames before contact, with an uncertainty that would bias the constants. The
last level therefore also fits velocity and spin with a prior, and a constant shift and enlargement of the rendered
body, which would otherwise appear as motion (`video_residuals`).

Families are fitted to the first frames and evaluated on the last ones, so that additional constants have no advantage.
Frames before the first contact do not depend on the law and are always fitted. A family is dropped if its images equal
those of a family that it contains, i.e. if its additional constants are at their limits. Uncertainty is estimated by a
block jackknife over the image and reported for combinations of constants, because some are not identifiable alone:
purely plastic flow determines the yield stress but not the stiffness. It is increased on plateaus of the loss, and by
the disagreement of the last frames or of tied families.

Several videos of one material share the constants, have one initial motion each, and equal weights.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.families import Family
from neuma_lib.fitting.identified import FamilyFit, Identified
from neuma_lib.fitting.least_squares import (
    MIN_COST,
    Linearisation,
    in_blocks,
    jackknife,
    levenberg_marquardt,
)
from neuma_lib.fitting.video_residuals import MOTION, NUISANCES, Candidate, VideoResiduals, averaged
from neuma_lib.mechanics.combinations import Values
from neuma_lib.sim.model import MPM
from neuma_lib.splatting.observation import Observation, joint_frames, several

_LAST_GAIN = 0.1  # factor on `min_gain` at the last level
_MIN_LOSS = 1e-12  # held-out loss of images that agree exactly


def identify(
    model: MPM,
    motion: InitialMotion,
    body: Reconstruction,
    observation: Observation | Sequence[Observation],
    settings: IdentifyConfig,
    published: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    refined: Sequence[Sequence[Reconstruction]] = (),
    other_videos: Sequence[tuple[InitialMotion, Reconstruction, Observation | Sequence[Observation]]] = (),
    progress: Callable[[int, int, float], None] | None = None,
    log: Callable[[str], None] = lambda text: None,
) -> Identified:
    """Identify the family and the constants of the material shown in a video.

    Args:
        model: simulator constants.
        motion: estimate of the initial motion from the frames before contact.
        body: reconstructed particles and Gaussians.
        observation: the video, or several of the same motion by cameras of different times, sizes or exposures, with
            the views of the settings.
        settings: candidates and hyper-parameters.
        published: specification of the law of the scene's prior, an additional start, or None if unknown.
        refined: for each video, resampled bodies with more particles for the discretisation correction, if any.
        other_videos: initial motion, body and observation of other videos of the same material.
        progress: called with (finished fits, number of fits, mean squared residual).
        log: receives a line for every family.

    Raises:
        InputError: fewer than four frames, no family, or one with unknown parts.
        NonFiniteError: every family diverges from every start.
    """
    given = [(motion, body, observation), *other_videos]
    if (count := min(len(joint_frames(several(video))) for *_, video in given)) < 4:
        raise InputError(
            "frames", f"{count} frames of the training view must be at least 4, to fit and to evaluate"
        )
    if not settings.families:
        raise InputError(
            "identify.families", "it has no candidates", "Add at least one elasticity with E and nu"
        )
    families = [Family(name, law.plain()) for name, law in settings.families.items()]
    families.sort(key=lambda family: len(family.constants))  # simpler families provide starts of the others
    resampled = refined or [()] * len(given)
    videos = [VideoResiduals(model, *one, settings, own) for one, own in zip(given, resampled, strict=True)]
    for video in videos:
        video.hold_out(families[0], settings.held_out)
        video.weight = (videos[0].fitted_pixels / video.fitted_pixels) ** 0.5
    published_values = _constants(published) if published else {}
    running: list[_Run] = []
    rounds = len(settings.pyramid)
    for family in families:
        running.append(_first_fit(family, videos, running, published_values, settings))
    for run, best in _better_later(running):
        run.restart_from(run.family.with_guesses({**run.values, **best.values}))
    total = rounds * len(families)
    for level in range(1, rounds):
        _prune(running, settings)
        following = sorted((run for run in running if run.alive), key=lambda run: run.fit.cost)
        if following and level == rounds - 1:
            following[0].measure_discretisation(derivatives=True)
            for run in following:
                run.clear_cache()
        for done, run in enumerate(following):
            run.refine(level)
            if progress:
                progress(level * len(families) + done + 1, total, run.loss)
    fits = {run.family.name: run.score() for run in running}
    for name, fit in fits.items():
        log(
            f"{name}: loss {fit.loss:.3e}, held out {fit.held_out:.3e}, {fit.rollouts} rollouts, "
            + ", ".join(f"{key} {value:.4g}" for key, value in fit.values.items())
        )
    selected, ties = _select(list(fits.values()), settings)
    run = next(run for run in running if run.family is selected.family)
    run.measure_discretisation()
    final = _Run(run.family, videos, [len(video.frames) for video in videos], settings)
    starts, first = [run.values], rounds - 1
    # If the first frames misled, restart at the coarsest level.
    if selected.held_out > settings.prune_factor * selected.loss:
        starts = [run.values, *(run.family.with_guesses(values) for values in ({}, published_values))]
        first = 0
    final.begin(starts, first, run.deviations)
    for level in range(first + 1, rounds if final.alive else 0):
        final.refine(level)
    best = final.score()
    if best.covariance is not None:
        best.covariance = final.inflated_covariance()
        best.widen_by_ties(selected, [fits[name] for name in ties])
    return Identified(
        best,
        ties,
        fits,
        [video.frames[: video.fitted] for video in videos],
        [video.frames[video.fitted :] for video in videos],
        sum(video.rollouts for video in videos),
        settings,
    )


def _first_fit(
    family: Family,
    videos: Sequence[VideoResiduals],
    running: Sequence[_Run],
    published_values: Values,
    settings: IdentifyConfig,
) -> _Run:
    """Fit of a family at the coarsest level, the better of two for a family with plastic flow.

    An elastic body is a limit of most of these families. At a coarse level, a very soft elastic body often fits better
    than any flow before its fit, but it is a local minimum because it never yields. One fit therefore starts from
    guesses with weaker limits of the flow. The other starts from the fits of other families, also nearer to their
    elastic limit, if that is better than the result of the first. Redundant fits are used only if there is no other.
    """
    guesses = [family.with_guesses(values) for values in ({}, published_values)]
    fitted = [family.with_guesses(values) for values in _fitted_values(running, family)]
    groups = [[*guesses, *fitted]]
    if family.flows and fitted:
        flowing = [*guesses, *family.with_other_limits(guesses[-1], (-1, -2))]
        groups = [flowing, [*fitted, *family.with_other_limits(fitted[0], (1, 2))]]
    fits = [_Run(family, videos, [video.fitted for video in videos], settings) for _ in groups]
    lowest = math.inf
    for run, starts in zip(fits, groups, strict=True):
        run.begin(starts, below=lowest)
        lowest = run.fit.cost if run.alive else math.inf
    best = min(fits, key=lambda run: (not run.alive, _is_redundant(run, running), run.loss))
    best.rollouts = sum(run.rollouts for run in fits)
    return best


def _better_later(running: Sequence[_Run]) -> list[tuple[_Run, _Run]]:
    """Pairs of a fit and a better one that started later: the best of all, and the best with the same constants."""
    ranked, pairs = sorted((run for run in running if run.alive), key=lambda run: run.fit.cost), []
    for at, run in enumerate(running):
        same = [other for other in ranked if other.family.constants == run.family.constants]
        leaders = dict.fromkeys([*ranked[:1], *same[:1]])
        pairs += [(run, best) for best in leaders if run.alive and best in running[at + 1 :]]
    return pairs


def _prune(running: Sequence[_Run], settings: IdentifyConfig) -> None:
    """Drop families whose loss exceeds ``prune_factor`` times the best, and redundant families.

    Families that do not improve on a simpler one at a coarse level are kept, since finer levels have more information.
    """
    alive = [run for run in running if run.alive]
    lowest = min((run.fit.cost for run in alive), default=0.0)
    dropped = [
        run for run in alive if run.fit.cost > settings.prune_factor * lowest or _is_redundant(run, alive)
    ]
    for run in dropped:
        run.alive = False


def _is_redundant(run: _Run, others: Sequence[_Run]) -> bool:
    """Whether a family that this one contains has the same images, so that its additional constants are at limits."""
    return any(run.alive and o.alive and run.family.contains(o.family) and run.resembles(o) for o in others)


def _fitted_values(running: Sequence[_Run], family: Family) -> list[Values]:
    """Starts from other families: constants of the best one, and of the largest ones that ``family`` contains."""
    alive = [run for run in running if run.alive]
    inner = [run for run in alive if family.contains(run.family)]
    size = max((len(run.family.constants) for run in inner), default=0)
    best = sorted(alive, key=lambda run: run.fit.cost)[:1]
    return [run.values for run in [*best, *(run for run in inner if len(run.family.constants) == size)]]


def _select(fits: Sequence[FamilyFit], settings: IdentifyConfig) -> tuple[FamilyFit, list[str]]:
    """The family with the lowest score, and the names of tied families.

    A family that contains the selected one is not tied, because its additional constants do not lower the score.
    """
    best = min(fits, key=lambda fit: fit.score)
    if not math.isfinite(best.score):
        raise NonFiniteError("identify", "every candidate diverges. Use softer guesses in identify.families")
    return best, [
        fit.family.name
        for fit in fits
        if fit is not best and fit.score - best.score < settings.tie and not fit.family.contains(best.family)
    ]


def _constants(spec: Mapping[str, Mapping[str, Any]]) -> Values:
    """All constants of a specification."""
    return {key: float(value) for part in spec.values() for key, value in part.items() if key != "name"}


def _squares(residual: Iterable[Tensor]) -> float:
    return sum(float(r.square().sum(dtype=torch.float64)) for r in residual)


class _Run:
    """Fit of one family to the first `counts` frames of each video, with residuals and Jacobians for all levels.

    Unknowns are the unbounded constants relative to the start of the fit, and the deviations of the initial motion of
    each video. Residuals and their columns are lists over the observations of all videos.
    """

    def __init__(
        self,
        family: Family,
        videos: Sequence[VideoResiduals],
        counts: Sequence[int],
        settings: IdentifyConfig,
    ):
        self.family, self.videos, self.counts, self.settings = family, videos, counts, settings
        self.alive, self.refined, self.rollouts, self.steps = False, False, 0, 0
        self.fit: Linearisation | None = None
        self._constants = len(family.constants)
        self._origin, self._level = np.zeros(0), 0
        self._u = np.zeros(self._constants + NUISANCES * len(videos))
        self._images: dict[bytes, list[Tensor] | None] = {}
        self._columns: dict[bytes, list[list[Tensor]]] = {}

    @cached_property
    def _places(self) -> list[tuple[int, int, int]]:
        """For every observation: index of its video, index within the video, and number of fitted frames."""
        return [
            (v, k, rows)
            for v, (video, count) in enumerate(zip(self.videos, self.counts, strict=True))
            for k, rows in enumerate(video.counts(count))
        ]

    @property
    def values(self) -> Values:
        return self._values(self._u)

    @property
    def deviations(self) -> np.ndarray:
        return self._u[self._constants :]

    @property
    def loss(self) -> float:
        """Mean squared residual at the current level, infinite without a simulation."""
        return self.fit.rms**2 if self.fit else math.inf

    def resembles(self, other: _Run) -> bool:
        """Whether the squared difference of the images is less than ``penalty`` times the squared residuals."""
        own, others = (run._at_level(run._residual(run._u)) for run in (self, other))
        pairs = zip(own, others, strict=True)
        return _squares(a - b for a, b in pairs) < self.settings.penalty * self.fit.cost

    def begin(
        self,
        starts: Sequence[Values],
        level: int = 0,
        deviations: np.ndarray | None = None,
        below: float = math.inf,
    ) -> None:
        """Fit at a level from the best of some starts, if its squared residuals are below a limit."""
        self._level = level
        unique = {tuple(values.values()): values for values in starts}
        origins = [self.family.unbounded(values) for values in unique.values()]
        if deviations is not None:
            self._u[self._constants :] = deviations
        self._origin, deviations = origins[0], self._u[self._constants :]
        residuals = self._simulate([np.append(origin - self._origin, deviations) for origin in origins])
        costs = [math.inf if residual is None else self._cost(residual) for residual in residuals]
        best = int(np.argmin(costs))
        self.alive = costs[best] < below
        if self.alive:
            self._origin, self._images = origins[best], {self._u.tobytes(): residuals[best]}
            self.refine(level)

    def restart_from(self, values: Values) -> None:
        """Continue from the constants of another family if they have a lower cost."""
        unknowns = np.append(self.family.unbounded(values) - self._origin, self._u[self._constants :])
        if self.cost(unknowns) < self.fit.cost:
            self._u = unknowns
            self.refine(self._level)

    def refine(self, level: int) -> None:
        """Continue the fit at a level of the pyramid."""
        self._level, last = level, level == len(self.settings.pyramid) - 1
        unsure = [k for v, video in enumerate(self.videos) if video.by_deviation for k in self._unsure(v)]
        self._u, self.fit, steps = levenberg_marquardt(
            self,
            self._u,
            [*range(self._constants), *unsure],
            self._prior,
            self.settings.min_gain * (_LAST_GAIN if last else 1.0),
            self.settings.iterations,
            longest=self.settings.longest_step,
        )
        self.steps += steps
        self.refined = last

    def _own(self, v: int) -> list[int]:
        """Indices of the deviations of a video."""
        first = self._constants + v * NUISANCES
        return list(range(first, first + NUISANCES))

    def _unsure(self, v: int) -> list[int]:
        """Indices of the deviations of a video that are not fixed to 0."""
        return [self._own(v)[k] for k in self.videos[v].unsure]

    def measure_discretisation(self, derivatives: bool = False) -> None:
        """Compute the discretisation correction, and optionally the derivatives by the deviations, at this fit."""
        law = self.family.law_spec(self.values)
        for v, video in enumerate(self.videos):
            here = Candidate(law, self._u[self._own(v)])
            if derivatives:
                video.differentiate(here)
            video.refine_particles(here)

    def clear_cache(self) -> None:
        """Drop cached residuals after a change of the discretisation correction."""
        self._images = {}

    def score(self) -> FamilyFit:
        """The result of the fit, evaluated on the held-out frames if any."""
        result = FamilyFit(self.family, self.values, self.loss, refined=self.refined, steps=self.steps)
        if self.fit is not None and self.refined:
            k = self._constants
            covariance = self._covariance()
            result.covariance, stds = covariance[:k, :k], np.sqrt(np.diag(covariance))
            result.motions = tuple(self._motion(v, stds) for v in range(len(self.videos)))
            if any(count < len(video.frames) for count, video in zip(self.counts, self.videos, strict=True)):
                result.held_out = self._held_out()
                result.score = math.log(max(result.held_out, _MIN_LOSS)) + self.settings.penalty * k
        result.rollouts = self.rollouts
        return result

    def _covariance(self) -> np.ndarray:
        """Covariance of all unknowns, to first order."""
        P = self._prior(self.fit)
        inverse = np.linalg.pinv(self.fit.curvature + P)
        by_prior = inverse @ P * self._spreads
        covariance = jackknife(self.fit, P) + by_prior @ by_prior.T
        for v, video in enumerate(self.videos):
            if video.spread is not None:
                by_particles = inverse @ self._slope(v, video.spread)
                covariance += np.outer(by_particles, by_particles)
        return covariance

    def inflated_covariance(self) -> np.ndarray:
        """Covariance (k, k) of the constants, inflated along axes where the images change less than linearly predicted.

        The cost is evaluated at two standard deviations along the undetermined principal axes, on the side where it
        increases less. The variance is multiplied by the ratio of the predicted to the actual increase, up to
        `IdentifyConfig.spread`, which accounts for plateaus.
        """
        k, whole = self._constants, self._covariance()
        variances, axes = np.linalg.eigh(whole[:k, :k])
        for variance, axis in zip(variances, axes.T, strict=True):
            if not self.settings.determined**2 < variance < self.settings.spread**2:
                continue
            # The deviations change according to their correlation with the constants.
            step = 2 * whole[:, :k] @ axis / math.sqrt(variance)
            residuals = self._simulate([self._u + step, self._u - step])
            costs = [math.inf if residual is None else self._cost(residual) for residual in residuals]
            predicted, actual = step @ self.fit.curvature @ step, max(min(costs) - self.fit.cost, MIN_COST)
            inflated = min(variance * max(predicted / actual, 1.0), self.settings.spread**2)
            whole[:k, :k] += (inflated - variance) * np.outer(axis, axis)
        return whole[:k, :k]

    def cost(self, unknowns: np.ndarray) -> float:
        """Sum of squared residuals, infinite if a rollout diverges."""
        residual = self._residual(unknowns)
        return math.inf if residual is None else self._cost(residual)

    def _cost(self, residual: Sequence[Tensor]) -> float:
        return _squares(self._at_level(residual))

    def linearise(self, unknowns: np.ndarray, free: Sequence[int]) -> Linearisation:
        """Sums of the residuals and of their forward differences for the blocks of all videos."""
        residual = self._residual(unknowns)
        key = unknowns.tobytes()
        self._images = {key: residual}  # the next level starts here
        if key not in self._columns:
            self._columns = {key: self._constant_columns(unknowns, residual)}
        curvatures, scores, k, averages = [], [], len(unknowns), self._at_level(residual)
        for at, r in enumerate(averages):
            columns = self._columns_of(at)
            own = [i for i in free if i in columns]
            J = torch.stack([in_blocks(self._averaged(at, columns[i])) for i in own], dim=-1).double()
            blocks = in_blocks(r).double()
            curvatures.append(np.zeros((len(J), k, k)))
            scores.append(np.zeros((len(J), k)))
            curvatures[at][:, np.array(own)[:, None], own] = (J.mT @ J).cpu().numpy()
            scores[at][:, own] = (J.mT @ blocks[..., None])[..., 0].cpu().numpy()
        cost = self._cost(residual)
        # With the weights, every video counts like the number of residuals of the first one.
        first = sum(r.numel() for r, (v, *_) in zip(averages, self._places, strict=True) if v == 0)
        count = len(self.videos) * first
        return Linearisation(
            np.concatenate(curvatures), np.concatenate(scores), cost, math.sqrt(cost / count)
        )

    def _columns_of(self, at: int) -> dict[int, Tensor]:
        """Derivatives of the residuals of an observation by the unknowns of its video, at the current fit."""
        (by_constants,), (v, k, rows) = self._columns.values(), self._places[at]
        own = zip(self._unsure(v), [each[k] for each in self.videos[v].by_deviation or ()], strict=False)
        return {i: column[:rows] for i, column in (*enumerate(c[at] for c in by_constants), *own)}

    def _slope(self, v: int, residual: Sequence[Tensor]) -> np.ndarray:
        """J^T r of another residual of a video, shape (k,)."""
        slope = np.zeros(len(self._u))
        for at, (video, k, rows) in enumerate(self._places):
            if video == v:
                r = self._averaged(at, residual[k][:rows]).double()
                for i, column in self._columns_of(at).items():
                    slope[i] += float((self._averaged(at, column) * r).sum())
        return slope

    def _motion(self, v: int, stds: np.ndarray) -> InitialMotion:
        """The fitted initial motion of a video, from the standard deviations of all unknowns."""
        own, motion = self._own(v)[:MOTION], self.videos[v].motion
        return replace(motion.moved(self._u[own]), std=motion.std * stds[own])

    def _constant_columns(self, unknowns: np.ndarray, residual: Sequence[Tensor]) -> list[list[Tensor]]:
        """Forward differences by the constants, or backward if the forward one diverges or exceeds the stiffness limit
        of dt, which the last step may have reached."""
        values, h = self._values(unknowns), self.settings.difference
        columns = [[torch.zeros_like(r) for r in residual]] * self._constants
        missing = range(self._constants)
        for step in (h, -h, -h - self.settings.longest_step):
            varied = {k: unknowns + step * np.eye(len(unknowns))[k] for k in missing}
            varied = {k: point for k, point in varied.items() if self._values(point) != values}
            for k, other in zip(varied, self._simulate(list(varied.values())), strict=True):
                if other is not None:
                    columns[k] = [(t - r) / step for t, r in zip(other, residual, strict=True)]
                    missing = [index for index in missing if index != k]
            if not missing:
                break
        return columns

    @property
    def _spreads(self) -> np.ndarray:
        """Prior standard deviations of the unknowns about 0."""
        deviations = np.ones(NUISANCES * len(self.videos))
        return np.append(np.full(self._constants, self.settings.spread), deviations)

    def _prior(self, fit: Linearisation) -> np.ndarray:
        """Curvature of the prior of the unknowns, with the residuals of a block over all videos counted as one."""
        return np.diag(fit.block_cost / len(self.videos) / self._spreads**2)

    def _values(self, unknowns: np.ndarray) -> Values:
        constants = self._origin + unknowns[: self._constants]
        density = min(video.density for video in self.videos)
        return self.family.values(constants, self.videos[0].model, density)

    def _residual(self, unknowns: np.ndarray) -> list[Tensor] | None:
        key = unknowns.tobytes()
        if key not in self._images:
            # Rejected points are not needed again.
            (residual,) = self._simulate([unknowns])
            self._images = dict([*list(self._images.items())[:1], (key, residual)])
        return self._images[key]

    def _simulate(
        self, points: Sequence[np.ndarray], counts: Sequence[int] | None = None
    ) -> list[list[Tensor] | None]:
        """Residuals of the videos at unknowns for the fitted or ``counts`` frames, None where a rollout diverges."""
        if not points:  # all differences of a step are beyond the stiffness limit of dt
            return []
        self.rollouts += len(points) * len(self.videos)
        laws = [self.family.law_spec(self._values(point)) for point in points]
        residuals = [
            video.residuals(
                [Candidate(law, p[self._own(v)]) for law, p in zip(laws, points, strict=True)], count
            )
            for v, (video, count) in enumerate(zip(self.videos, counts or self.counts, strict=True))
        ]
        return [
            None if any(r is None for r in of_all) else [r for own in of_all for r in own]
            for of_all in zip(*residuals, strict=True)
        ]

    def _at_level(self, residual: Sequence[Tensor]) -> list[Tensor]:
        return [self._averaged(at, r) for at, r in enumerate(residual)]

    def _averaged(self, at: int, images: Tensor) -> Tensor:
        return averaged(images, self.videos[self._places[at][0]].sizes[self._level])

    def _held_out(self) -> float:
        """Mean squared residual of the frames after the fitted ones, infinite if a rollout diverges there."""
        (residual,) = self._simulate([self._u], [len(video.frames) for video in self.videos])
        if residual is None:
            return math.inf
        later = [(v, r[rows:].flatten()) for r, (v, _, rows) in zip(residual, self._places, strict=True)]
        losses = [
            float(torch.cat([r for owner, r in later if owner == v]).double().square().mean())
            / video.weight**2
            for v, video in enumerate(self.videos)
        ]
        return sum(losses) / len(losses)
