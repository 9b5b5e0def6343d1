"""Fit of one family of laws, or one for each of several bodies, to the frames of videos: residuals, Jacobian and
uncertainty (used by `identify` and `identify_bodies`)."""

import copy
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.errors import NonFiniteError
from neuma_lib.fitting.families import FRICTION, Bodies, Family
from neuma_lib.fitting.identified import FamilyFit
from neuma_lib.fitting.least_squares import (
    MIN_COST,
    Linearisation,
    block_sums,
    jackknife,
    laplace,
    levenberg_marquardt,
    secant_update,
)
from neuma_lib.fitting.video_residuals import MOTION, NUISANCES, Candidate, VideoResiduals, averaged
from neuma_lib.mechanics.combinations import Values

_LAST_GAIN = 0.1  # factor on `min_gain` at the last level, unless the fit is rough
_EXCLUDED = 2.0  # standard deviations at which a Coulomb coefficient is excluded
_FRICTIONS, _FRICTION_FACTOR = 8, 2.0  # coefficients that are tried together, and their ratio
_MIN_LOSS = 1e-12  # held-out loss of images that agree exactly


def _squares(residual: Iterable[Tensor]) -> float:
    return sum(float(r.square().sum(dtype=torch.float64)) for r in residual)


class FamilyRun:
    """Fit of one family to the first `counts` frames of each video, with residuals and Jacobians for all levels.

    Unknowns are the unbounded constants relative to the start of the fit, and the deviations of the initial motion of
    each video. Residuals and their columns are lists over the observations of all videos.
    """

    def __init__(
        self,
        family: Family | Bodies,
        videos: Sequence[VideoResiduals],
        counts: Sequence[int],
        settings: IdentifyConfig,
        fine: bool = False,
    ):
        self.family, self.videos, self.counts, self.settings = family, videos, counts, settings
        self._fine = fine
        self.alive, self.refined, self.rollouts, self.steps = False, False, 0, 0
        self.fit: Linearisation | None = None
        self._constants = len(family.constants)
        self._origin, self._level = np.zeros(0), 0
        self._firsts = np.cumsum([self._constants, *(video.deviations for video in videos)]).tolist()
        self._u = np.zeros(self._firsts[-1])
        self._images: dict[bytes, list[Tensor] | None] = {}
        self._columns: dict[bytes, list[list[Tensor]]] = {}
        self._exact = True

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
    def columns(self) -> list[list[Tensor]]:
        """Derivatives by the constants at the end of the fit."""
        (columns,) = self._columns.values()
        return columns

    @property
    def loss(self) -> float:
        """Mean squared residual at the current level, infinite without a simulation."""
        return self.fit.rms**2 if self.fit else math.inf

    def resembles(self, other: "FamilyRun") -> bool:
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
        like: "Iterable[FamilyRun]" = (),
        **how: Any,
    ) -> None:
        """Fit at a level from the best of some starts, if its squared residuals are below a limit.

        Args:
            like: fits to the same frames. This one begins with the derivatives of the first with the same constants.
            how: options of `refine`.
        """
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
            similar = [run for run in like if run.alive and run.family.constants == self.family.constants]
            if similar:
                self._columns, self._exact = {self._u.tobytes(): similar[0].columns}, False
            self.refine(level, **how)

    def restart_from(self, starts: Sequence[Values]) -> None:
        """Continue from the best of some constants if it has a lower cost."""
        deviations = self._u[self._constants :]
        points = [np.append(self.family.unbounded(start) - self._origin, deviations) for start in starts]
        residuals = self._simulate(points)
        costs = [math.inf if residual is None else self._cost(residual) for residual in residuals]
        best = int(np.argmin(costs))
        if costs[best] < self.fit.cost:
            self._u, self._images = points[best], {points[best].tobytes(): residuals[best]}
            self.refine(self._level)

    def refine(self, level: int, rough: bool = False, limit: float = math.inf) -> None:
        """Continue the fit at a level of the pyramid.

        Args:
            rough: end early, with derivatives that have been updated, as always before the last level.
            limit: cost beyond which the fit ends.
        """
        self._level, last = level, level == len(self.settings.pyramid) - 1
        self._u, self.fit, steps = levenberg_marquardt(
            self,
            self._u,
            self._free,
            self._prior,
            self.settings.min_gain * (1.0 if rough or not last else _LAST_GAIN),
            self.settings.iterations,
            longest=self.settings.longest_step,
            secant=True,
            rough=rough or not last,
            limit=limit,
        )
        self.steps += steps
        self.refined = last

    def _own(self, v: int) -> list[int]:
        """Indices of the deviations of a video."""
        return list(range(*self._firsts[v : v + 2]))

    def _unsure(self, v: int) -> list[int]:
        """Indices of the deviations of a video that are not fixed to 0."""
        return [self._own(v)[k] for k in self.videos[v].unsure]

    @property
    def _free(self) -> list[int]:
        """Indices of the unknowns that are fitted."""
        unsure = [k for v, video in enumerate(self.videos) if video.by_deviation for k in self._unsure(v)]
        return [*range(self._constants), *unsure]

    def differentiate(self) -> None:
        """Compute the derivatives of the residuals of all videos by the deviations at this fit."""
        for v, video in enumerate(self.videos):
            video.differentiate(self._candidate(self._u, v))

    def linearise_at(self, values: Values, covariance: np.ndarray | None = None) -> Linearisation:
        """The problem at the last level, linearised at constants and the estimated motions without a fit.

        Args:
            covariance: that of the unbounded constants, shape (k, k). Differences then have the width of a standard
                deviation along its principal axes, on the side where the images change less, since a derivative hides
                plateaus of the images (see `covariance_of_plateaus`). None: derivatives.

        Raises:
            NonFiniteError: the rollout diverges.
        """
        self._origin, self._level = self.family.unbounded(values), len(self.settings.pyramid) - 1
        if not math.isfinite(self.cost(self._u)):
            raise NonFiniteError(self.family.name, "the simulation with the identified constants diverges")
        if any(video.by_deviation is None for video in self.videos):
            self.differentiate()
        if covariance is not None:
            self._columns = {self._u.tobytes(): self._wide_columns(covariance)}
            self._exact = True
        return self.linearise(self._u, self._free)

    def _wide_columns(self, covariance: np.ndarray) -> list[list[Tensor]]:
        """Columns of the constants from differences of a standard deviation along principal axes (`linearise_at`)."""
        base, k = self._residual(self._u), self._constants
        variances, axes = np.linalg.eigh(covariance)
        widths = np.clip(np.sqrt(variances), self.settings.difference, self.settings.longest_step)
        columns = [[torch.zeros_like(r) for r in base] for _ in range(k)]
        for width, axis in zip(widths, axes.T, strict=True):
            step = np.append(width * axis, np.zeros(len(self._u) - k))
            points = [point for point in (self._u + step, self._u - step) if self._reaches(point)]
            changes = [
                [(t - r) * (sign / width) for t, r in zip(other, base, strict=True)]
                for other, sign in zip(
                    self._simulate(points),
                    (float(np.sign((p - self._u) @ step)) for p in points),
                    strict=True,
                )
                if other is not None
            ]
            if changes:
                change = min(changes, key=lambda each: _squares(self._at_level(each)))
                for column, part in zip(columns, axis, strict=True):
                    for own, each in zip(column, change, strict=True):
                        own += part * each
        return columns

    def _reaches(self, unknowns: np.ndarray) -> bool:
        """Whether the stiffness limit of dt admits the constants of unknowns."""
        reached = self.family.unbounded(self._values(unknowns)) - self._origin
        return bool(np.allclose(reached, unknowns[: self._constants], atol=1e-6))

    def imitate(self, values: Values, noise: float) -> None:
        """Fit at the last level from constants, with a known variance of the residuals per unit of curvature.

        Raises:
            NonFiniteError: the rollout diverges.
        """
        self.linearise_at(values)
        P = np.diag(noise / self._spreads**2)
        self._u, self.fit, _ = levenberg_marquardt(
            self,
            self._u,
            self._free,
            lambda fit: P,
            self.settings.min_gain,
            self.settings.iterations,
            longest=self.settings.longest_step,
        )

    def score(self) -> FamilyFit:
        """The result of the fit, evaluated on the held-out frames if any."""
        result = FamilyFit(self.family, self.values, self.loss, refined=self.refined, steps=self.steps)
        if self.fit is not None and self.refined:
            k = self._constants
            covariance = self._covariance()
            result.covariance, stds = covariance[:k, :k], np.sqrt(np.diag(covariance))
            result.laplace = laplace(self.fit, self._spreads)[:k, :k]
            result.motions = tuple(each for v in range(len(self.videos)) for each in self._motions(v, stds))
            if any(count < len(video.frames) for count, video in zip(self.counts, self.videos, strict=True)):
                result.held_out = self._held_out()
                result.score = math.log(max(result.held_out, _MIN_LOSS)) + self.settings.penalty * k
        result.rollouts = self.rollouts
        return result

    def _covariance(self) -> np.ndarray:
        """Covariance of all unknowns, to first order."""
        P = self._prior(self.fit)
        by_prior = np.linalg.pinv(self.fit.curvature + P) @ P * self._spreads
        return jackknife(self.fit, P) + by_prior @ by_prior.T

    def covariance_of_plateaus(self) -> np.ndarray:
        """Covariance (k, k) to add along axes where the images change less than linearly predicted.

        The cost is evaluated at two standard deviations along the undetermined principal axes, on the side where it
        increases less. The variance is multiplied by the ratio of the predicted to the actual increase, up to
        `IdentifyConfig.spread`, which accounts for plateaus.

        A fit that ends before its minimum has a slope, by which the cost increases less on one side without a plateau.
        With `IdentifyConfig.level_plateaus`, the increase is that above the slope between half a standard deviation on
        either side.
        """
        k, whole = self._constants, self._covariance()
        variances, axes = np.linalg.eigh(whole[:k, :k])
        added = np.zeros((k, k))
        for variance, axis in zip(variances, axes.T, strict=True):
            if not self.settings.determined**2 < variance < self.settings.spread**2:
                continue
            # The deviations change according to their correlation with the constants.
            step = 2 * whole[:, :k] @ axis / math.sqrt(variance)
            points = [self._u + step, self._u - step]
            if self.settings.level_plateaus:
                points += [self._u + step / 4, self._u - step / 4]
            residuals = self._simulate(points)
            costs = [math.inf if residual is None else self._cost(residual) for residual in residuals]
            near = costs[2:]
            slope = 2 * (near[0] - near[1]) if near and math.isfinite(sum(near)) else 0.0
            lowest = min(costs[0] - slope, costs[1] + slope)
            predicted, actual = step @ self.fit.curvature @ step, max(lowest - self.fit.cost, MIN_COST)
            inflated = min(variance * max(predicted / actual, 1.0), self.settings.spread**2)
            added += (inflated - variance) * np.outer(axis, axis)
        return added

    def lowest_friction(self) -> float | None:
        """The smallest Coulomb coefficient that the images admit if they also admit sticking, else None, also if it is
        not fitted.

        An admitted coefficient is at most `_EXCLUDED` standard deviations away. The distance follows from the
        jackknife with the difference between its images and those of the fit in place of the derivative.
        """
        if not self.family.contact_friction or not self._admits([math.inf])[0]:
            return None
        value = self.values[FRICTION]
        for factor in (_FRICTION_FACTOR, _FRICTION_FACTOR ** (1 / _FRICTIONS)):
            lower = [value / factor**n for n in range(1, _FRICTIONS + 1)]
            admitted = [*self._admits(lower), False].index(False)
            value = ([value, *lower])[admitted]
        return value

    def _admits(self, frictions: Sequence[float]) -> list[bool]:
        """Whether the images of the fit are compatible with Coulomb coefficients, for other constants as needed."""
        k, base = self.family.constants.index(FRICTION), self._residual(self._u)
        points = [self._u.copy() for _ in frictions]
        for point, friction in zip(points, frictions, strict=True):
            point[k] = np.log(friction) - self._origin[k]
        return [
            other is not None
            and self._distance(k, [t - r for t, r in zip(other, base, strict=True)]) < _EXCLUDED
            for other in self._simulate(points)
        ]

    def _distance(self, k: int, change: list[Tensor]) -> float:
        """Standard deviations between the best fit along a change of the images and the whole change."""
        ((key, columns),) = self._columns.items()
        line, here = copy.copy(self), self._u.copy()
        line._columns, here[k] = {key: [*columns[:k], change, *columns[k + 1 :]]}, 0.0
        line.fit = line.linearise(self._u, self._free)
        P = line._prior(line.fit)
        step = -np.linalg.pinv(line.fit.curvature + P) @ (line.fit.slope + P @ here)
        return (1 - step[k]) / math.sqrt(line._covariance()[k, k])

    def cost(self, unknowns: np.ndarray) -> float:
        """Sum of squared residuals, infinite if a rollout diverges."""
        residual = self._residual(unknowns)
        return math.inf if residual is None else self._cost(residual)

    def _cost(self, residual: Sequence[Tensor]) -> float:
        return _squares(self._at_level(residual))

    def linearise(self, unknowns: np.ndarray, free: Sequence[int], exact: bool = True) -> Linearisation:
        """Sums of the residuals and of their derivatives for the blocks of all videos.

        Derivatives by the constants are forward differences, or updated from those before a step.
        """
        residual = self._residual(unknowns)
        key = unknowns.tobytes()
        if key not in self._columns or exact and not self._exact:
            self._exact = exact or not any(before in self._images for before in self._columns)
            columns = self._constant_columns if self._exact else self._updated_columns
            self._columns = {key: columns(unknowns, residual)}
        self._images = {key: residual}  # the next level starts here
        curvatures, scores, k, averages = [], [], len(unknowns), self._at_level(residual)
        for at, r in enumerate(averages):
            columns = self._columns_of(at)
            own = [i for i in free if i in columns]
            curvature, score = block_sums([self._averaged(at, columns[i]) for i in own], r)
            curvatures.append(np.zeros((len(curvature), k, k)))
            scores.append(np.zeros((len(score), k)))
            curvatures[at][:, np.array(own)[:, None], own] = curvature
            scores[at][:, own] = score
        cost = self._cost(residual)
        # With the weights, every video counts like the number of residuals of the first one.
        first = sum(r.numel() for r, (v, *_) in zip(averages, self._places, strict=True) if v == 0)
        count = len(self.videos) * first
        return Linearisation(
            np.concatenate(curvatures), np.concatenate(scores), cost, math.sqrt(cost / count), self._exact
        )

    def _columns_of(self, at: int) -> dict[int, Tensor]:
        """Derivatives of the residuals of an observation by the unknowns of its video, at the current fit."""
        by_constants, (v, k, rows) = self.columns, self._places[at]
        own = zip(self._unsure(v), [each[k] for each in self.videos[v].by_deviation or ()], strict=False)
        return {i: column[:rows] for i, column in (*enumerate(c[at] for c in by_constants), *own)}

    def _motions(self, v: int, stds: np.ndarray) -> list[InitialMotion]:
        """The fitted initial motions of the bodies of a video, from the standard deviations of all unknowns."""
        return [
            replace(motion.moved(self._u[own]), std=motion.std * stds[own])
            for motion, own in zip(
                self.videos[v].motions, np.reshape(self._own(v), (-1, NUISANCES))[:, :MOTION], strict=True
            )
        ]

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

    def _updated_columns(self, unknowns: np.ndarray, residual: Sequence[Tensor]) -> list[list[Tensor]]:
        """Derivatives by the constants after a step from where they were known, which `_images` still has."""
        ((key, columns),) = self._columns.items()
        before, step = self._images[key], unknowns - np.frombuffer(key)
        own = step[: self._constants].tolist()
        if not any(own):
            return columns
        updated = []
        for at, (new, old) in enumerate(zip(residual, before, strict=True)):
            predicted = sum(step[i] * column for i, column in self._columns_of(at).items())
            updated.append(secant_update([column[at] for column in columns], own, new - old - predicted))
        return [list(column) for column in zip(*updated, strict=True)]

    @property
    def _spreads(self) -> np.ndarray:
        """Prior standard deviations of the unknowns about 0."""
        deviations = np.ones(self._firsts[-1] - self._constants)
        return np.append(np.full(self._constants, self.settings.spread), deviations)

    def _prior(self, fit: Linearisation) -> np.ndarray:
        """Curvature of the prior of the unknowns, with the residuals of a block over all videos counted as one."""
        return np.diag(fit.block_cost / len(self.videos) / self._spreads**2)

    def _values(self, unknowns: np.ndarray) -> Values:
        constants = self._origin + unknowns[: self._constants]
        density = min(video.density for video in self.videos)
        return self.family.values(constants, self.videos[0].model, density)

    def _candidate(self, unknowns: np.ndarray, v: int) -> Candidate:
        """The simulation of a video at unknowns."""
        values = self._values(unknowns)
        law, pairs = self.family.law_spec(values), self.family.pair_frictions(values)
        return Candidate(law, unknowns[self._own(v)], values.get(FRICTION), pairs)

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
        residuals = [
            video.residuals([self._candidate(point, v) for point in points], count, self._fine)
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
        """Mean squared residual of the frames after the fitted ones relative to the noise, infinite if a rollout
        diverges there."""
        (residual,) = self._simulate([self._u], [len(video.frames) for video in self.videos])
        if residual is None:
            return math.inf
        later = [(v, r[rows:].flatten()) for r, (v, _, rows) in zip(residual, self._places, strict=True)]
        losses = [
            float(torch.cat([r for owner, r in later if owner == v]).double().square().mean())
            / (video.weight**2 * video.noise)
            for v, video in enumerate(self.videos)
        ]
        return sum(losses) / len(losses)
