"""The material in a video: the constants of every candidate family, and the family that predicts best.

Each family is fitted by Levenberg-Marquardt through rollout and renderer: a handful of constants, whose Jacobian is a
handful of rollouts. The residuals of sharp images have a basin a pixel wide; averaged over large squares, and over
smaller ones in turn, they lead there from afar. Constants are unbounded logarithms and logits. A family starts from the
best of its own guess, the scene's prior and what simpler families have found; one that falls far behind is given up.

How the body was thrown is known from the frames before contact, up to an uncertainty that the constants would take up.
So the last round fits velocity and spin along, held by what is known of them, and a constant shift and enlargement of
the rendered body, which would be taken for motion (`thrown_video`).

Families are fitted to the first frames and judged by the last ones, so that more constants do not win by themselves;
frames before the first contact tell nothing of a law and are among those that are fitted. One that shows the images of
a family that it contains, its further constants at their limits, is not followed to the end.
What the video says of the constants of a family is told by the jackknife over blocks of the image, in combinations:
of a flow that never springs back, the flow stress is seen and the stiffness is not. Wider are those that are on a
plateau, that the last frames have moved, or that families which predict as well disagree about.

Several videos of one material have the constants in common and a throw each; they count alike, however long.
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
from neuma_lib.fitting.thrown_video import MOTION, NUISANCES, ThrownVideo, Try, averaged
from neuma_lib.mechanics.combinations import Values
from neuma_lib.sim.model import MPM
from neuma_lib.splatting.observation import Observation, joint_frames, several

_LAST_GAIN = 0.1  # of `min_gain`, in the last round
_LEAST_LOSS = 1e-12  # below it, held-out images agree exactly


def identify(
    model: MPM,
    throw: InitialMotion,
    body: Reconstruction,
    observation: Observation | Sequence[Observation],
    settings: IdentifyConfig,
    stock: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    finer: Sequence[Sequence[Reconstruction]] = (),
    further: Sequence[tuple[InitialMotion, Reconstruction, Observation | Sequence[Observation]]] = (),
    progress: Callable[[int, int, float], None] | None = None,
    log: Callable[[str], None] = lambda text: None,
) -> Identified:
    """Find the family and the constants of the material that a video shows.

    Args:
        model: simulator constants.
        throw: how the body is thrown, as the frames before contact tell.
        body: reconstructed particles and Gaussians.
        observation: the video, or several of the same throw by cameras of other times, sizes or exposures; their views
            are those of the settings.
        settings: candidates and hyper-parameters.
        stock: specification of the law that the scene's prior was trained on: another start; None if unknown.
        finer: of each video, the same body filled anew with more particles, once or several times; none: what the
            coarseness of the body changes is not corrected.
        further: throw, body and video of others of the same material.
        progress: called with (rounds done, rounds, mean squared residual).
        log: receives a line for every family.

    Raises:
        InputError: fewer than four frames, no family, or one with unknown parts.
        NonFiniteError: every family diverges from every start.
    """
    given = [(throw, body, observation), *further]
    if min(len(joint_frames(several(seen))) for *_, seen in given) < 4:
        raise InputError("identify needs at least four frames of the training view, to fit and to judge by")
    if not settings.families:
        raise InputError("identify.families names no candidate: give at least one elasticity with E and nu")
    families = [Family(name, law.plain()) for name, law in settings.families.items()]
    families.sort(key=lambda family: len(family.constants))  # simpler ones give starts to the others
    fillings = finer or [()] * len(given)
    videos = [ThrownVideo(model, *one, settings, own) for one, own in zip(given, fillings, strict=True)]
    for video in videos:
        video.hold_out(families[0], settings.held_out)
        video.weight = (videos[0].fitted_pixels / video.fitted_pixels) ** 0.5
    stock_values = _constants(stock) if stock else {}
    running: list[_Run] = []
    rounds = len(settings.pyramid)
    for family in families:
        running.append(_begun(family, videos, running, stock_values, settings))
    for run, best in _better_later(running):
        run.reconsider(run.family.with_guesses({**run.values, **best.values}))
    total = rounds * len(families)
    for level in range(1, rounds):
        _leave_behind(running, settings)
        following = sorted((run for run in running if run.alive), key=lambda run: run.fit.cost)
        if following and level == rounds - 1:
            following[0].look_closer(derivatives=True)
            for run in following:
                run.forget()
        for done, run in enumerate(following):
            run.refine(level)
            if progress:
                progress(level * len(families) + done + 1, total, run.loss)
    fits = {run.family.name: run.judged() for run in running}
    for name, fit in fits.items():
        log(
            f"{name}: loss {fit.loss:.3e}, held out {fit.held_out:.3e}, {fit.rollouts} rollouts, "
            + ", ".join(f"{key} {value:.4g}" for key, value in fit.values.items())
        )
    chosen, ties = _choice(list(fits.values()), settings)
    run = next(run for run in running if run.family is chosen.family)
    run.look_closer()
    final = _Run(run.family, videos, [len(video.frames) for video in videos], settings)
    starts, first = [run.values], rounds - 1
    if chosen.held_out > settings.prune_factor * chosen.loss:  # the first frames misled: from the beginning
        starts, first = [run.values, *(run.family.with_guesses(values) for values in ({}, stock_values))], 0
    final.begin(starts, first, run.deviations)
    for level in range(first + 1, rounds if final.alive else 0):
        final.refine(level)
    best = final.judged()
    if best.covariance is not None:
        best.covariance = final.widened()
        best.disagree(chosen, [fits[name] for name in ties])
    return Identified(
        best,
        ties,
        fits,
        [video.frames[: video.fitted] for video in videos],
        [video.frames[video.fitted :] for video in videos],
        sum(video.rollouts for video in videos),
        settings,
    )


def _begun(
    family: Family,
    videos: Sequence[ThrownVideo],
    running: Sequence[_Run],
    stock_values: Values,
    settings: IdentifyConfig,
) -> _Run:
    """A family's fit in the first round, the better of two where it flows.

    An elastic body is among the limits of most families that flow. Seen coarsely, one as soft as to lie flat is a
    better start than any flow that is not fitted yet, but nothing leads away from it: it never yields. So guesses, with
    less to limit the flow, are one start; what other families have found, nearer to their elastic limit too, is
    another if it is better than where the first one led. A fit that shows what a family within it shows already is
    taken only if there is no other.
    """
    guesses = [family.with_guesses(values) for values in ({}, stock_values)]
    found = [family.with_guesses(values) for values in _found(running, family)]
    groups = [[*guesses, *found]]
    if family.flows and found:
        flowing = [*guesses, *family.with_other_limits(guesses[-1], (-1, -2))]
        groups = [flowing, [*found, *family.with_other_limits(found[0], (1, 2))]]
    fits = [_Run(family, videos, [video.fitted for video in videos], settings) for _ in groups]
    least = math.inf
    for run, starts in zip(fits, groups, strict=True):
        run.begin(starts, below=least)
        least = run.fit.cost if run.alive else math.inf
    best = min(fits, key=lambda run: (not run.alive, _adds_nothing(run, running), run.loss))
    best.rollouts = sum(run.rollouts for run in fits)
    return best


def _better_later(running: Sequence[_Run]) -> list[tuple[_Run, _Run]]:
    """Fits, each with the best of all and with the best of the same constants where these began after it."""
    ranked, pairs = sorted((run for run in running if run.alive), key=lambda run: run.fit.cost), []
    for at, run in enumerate(running):
        alike = [other for other in ranked if other.family.constants == run.family.constants]
        leaders = dict.fromkeys([*ranked[:1], *alike[:1]])
        pairs += [(run, best) for best in leaders if run.alive and best in running[at + 1 :]]
    return pairs


def _leave_behind(running: Sequence[_Run], settings: IdentifyConfig) -> None:
    """Give up families that are far behind the best one, or show what one that they contain shows.

    One that merely explains blurred images no better than a simpler one goes on: finer squares tell more.
    """
    alive = [run for run in running if run.alive]
    least = min((run.fit.cost for run in alive), default=0.0)
    left = [run for run in alive if run.fit.cost > settings.prune_factor * least or _adds_nothing(run, alive)]
    for run in left:
        run.alive = False


def _adds_nothing(run: _Run, others: Sequence[_Run]) -> bool:
    """Whether a family that this one contains shows the same images: its further constants are at their limits."""
    return any(run.alive and o.alive and run.family.contains(o.family) and run.resembles(o) for o in others)


def _found(running: Sequence[_Run], family: Family) -> list[Values]:
    """Constants that other families give to start from: those of the best one, and of the largest that it contains."""
    alive = [run for run in running if run.alive]
    inner = [run for run in alive if family.contains(run.family)]
    size = max((len(run.family.constants) for run in inner), default=0)
    best = sorted(alive, key=lambda run: run.fit.cost)[:1]
    return [run.values for run in [*best, *(run for run in inner if len(run.family.constants) == size)]]


def _choice(fits: Sequence[FamilyFit], settings: IdentifyConfig) -> tuple[FamilyFit, list[str]]:
    """The family of the least score, and the names of those that are as good.

    A family that contains the chosen one is no rival: its further constants gained nothing.
    """
    best = min(fits, key=lambda fit: fit.score)
    if not math.isfinite(best.score):
        raise NonFiniteError("identify", "every candidate diverges: give softer guesses in identify.families")
    return best, [
        fit.family.name
        for fit in fits
        if fit is not best and fit.score - best.score < settings.tie and not fit.family.contains(best.family)
    ]


def _constants(spec: Mapping[str, Mapping[str, Any]]) -> Values:
    """All constants of a law's specification."""
    return {key: float(value) for part in spec.values() for key, value in part.items() if key != "name"}


def _squares(residual: Iterable[Tensor]) -> float:
    return sum(float(r.square().sum(dtype=torch.float64)) for r in residual)


class _Run:
    """The fit of one family to the first frames; residuals and Jacobians serve all sizes of squares.

    Unknowns are the unbounded constants, relative to the start of the fit, and the deviations of each video's throw.
    Residuals and their columns are lists over the observations of all videos, one after the other; `counts` of the
    frames of each video are fitted.
    """

    def __init__(
        self, family: Family, videos: Sequence[ThrownVideo], counts: Sequence[int], settings: IdentifyConfig
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
        """Of every observation: its video, its place there, and how many of its frames are fitted."""
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
        """Mean squared residual at the present squares; infinite if nothing was simulated."""
        return self.fit.rms**2 if self.fit else math.inf

    def resembles(self, other: _Run) -> bool:
        """Whether the images differ by less than a part, the penalty of a constant, of what both leave unexplained."""
        pairs = zip(self._seen(self._residual(self._u)), other._seen(other._residual(other._u)), strict=True)
        return _squares(a - b for a, b in pairs) < self.settings.penalty * self.fit.cost

    def begin(
        self,
        starts: Sequence[Values],
        level: int = 0,
        deviations: np.ndarray | None = None,
        below: float = math.inf,
    ) -> None:
        """Fit from the best of some starts, in a round, if its squared residuals are below a number."""
        self._level = level
        tried = {tuple(values.values()): values for values in starts}
        origins = [self.family.unbounded(values) for values in tried.values()]
        if deviations is not None:
            self._u[self._constants :] = deviations
        self._origin, deviations = origins[0], self._u[self._constants :]
        found = self._simulate([np.append(origin - self._origin, deviations) for origin in origins])
        costs = [math.inf if residual is None else self._cost(residual) for residual in found]
        best = int(np.argmin(costs))
        self.alive = costs[best] < below
        if self.alive:
            self._origin, self._images = origins[best], {self._u.tobytes(): found[best]}
            self.refine(level)

    def reconsider(self, values: Values) -> None:
        """Go on from constants that another family has found, if they suit this one better than its own."""
        there = np.append(self.family.unbounded(values) - self._origin, self._u[self._constants :])
        if self.cost(there) < self.fit.cost:
            self._u = there
            self.refine(self._level)

    def refine(self, level: int) -> None:
        """Go on with a round's squares."""
        self._level, last = level, level == len(self.settings.pyramid) - 1
        unsure = [k for v, video in enumerate(self.videos) if video.by_deviation for k in self._unsure(v)]
        self._u, self.fit, steps = levenberg_marquardt(
            self,
            self._u,
            [*range(self._constants), *unsure],
            self._held,
            self.settings.min_gain * (_LAST_GAIN if last else 1.0),
            self.settings.iterations,
            longest=self.settings.longest_step,
        )
        self.steps += steps
        self.refined = last

    def _own(self, v: int) -> list[int]:
        """Places of the deviations of a video."""
        first = self._constants + v * NUISANCES
        return list(range(first, first + NUISANCES))

    def _unsure(self, v: int) -> list[int]:
        """Places of those that are not known to be 0."""
        return [self._own(v)[k] for k in self.videos[v].unsure]

    def look_closer(self, derivatives: bool = False) -> None:
        """Let the videos learn what more particles change, and what the deviations do, where the fit stands."""
        law = self.family.law_spec(self.values)
        for v, video in enumerate(self.videos):
            here = Try(law, self._u[self._own(v)])
            if derivatives:
                video.differentiate(here)
            video.refine_particles(here)

    def forget(self) -> None:
        """Simulate again where the fit stands, because the videos add something else now."""
        self._images = {}

    def judged(self) -> FamilyFit:
        """What was found, judged by the frames that were held out, if any."""
        found = FamilyFit(self.family, self.values, self.loss, refined=self.refined, steps=self.steps)
        if self.fit is not None and self.refined:
            k = self._constants
            covariance = self._covariance()
            found.covariance, stds = covariance[:k, :k], np.sqrt(np.diag(covariance))
            found.throws = tuple(self._thrown(v, stds) for v in range(len(self.videos)))
            if any(count < len(video.frames) for count, video in zip(self.counts, self.videos, strict=True)):
                found.held_out = self._held_out()
                found.score = math.log(max(found.held_out, _LEAST_LOSS)) + self.settings.penalty * k
        found.rollouts = self.rollouts
        return found

    def _covariance(self) -> np.ndarray:
        """Covariance of all unknowns, to first order."""
        P = self._held(self.fit)
        inverse = np.linalg.pinv(self.fit.curvature + P)
        by_prior = inverse @ P * self._spreads
        covariance = jackknife(self.fit, P) + by_prior @ by_prior.T
        for v, video in enumerate(self.videos):
            if video.spread is not None:
                by_particles = inverse @ self._slope(v, video.spread)
                covariance += np.outer(by_particles, by_particles)
        return covariance

    def widened(self) -> np.ndarray:
        """Covariance (k, k) of the constants, larger along axes where the images change less than the derivatives tell.

        Of the principal axes, those that are not determined are followed for two standard deviations, to the side where
        the squared residuals rise less: the variance grows by how much less than the quadratic, up to
        `IdentifyConfig.spread`. A plateau has small derivatives somewhere, and a wide range all the same.
        """
        k, whole = self._constants, self._covariance()
        variances, axes = np.linalg.eigh(whole[:k, :k])
        for variance, axis in zip(variances, axes.T, strict=True):
            if not self.settings.determined**2 < variance < self.settings.spread**2:
                continue
            # The deviations follow the constants as they are correlated.
            step = 2 * whole[:, :k] @ axis / math.sqrt(variance)
            found = self._simulate([self._u + step, self._u - step])
            costs = [math.inf if residual is None else self._cost(residual) for residual in found]
            promised, rise = step @ self.fit.curvature @ step, max(min(costs) - self.fit.cost, MIN_COST)
            wider = min(variance * max(promised / rise, 1.0), self.settings.spread**2)
            whole[:k, :k] += (wider - variance) * np.outer(axis, axis)
        return whole[:k, :k]

    def cost(self, unknowns: np.ndarray) -> float:
        """Sum of squared residuals, infinite if a rollout diverges."""
        residual = self._residual(unknowns)
        return math.inf if residual is None else self._cost(residual)

    def _cost(self, residual: Sequence[Tensor]) -> float:
        return _squares(self._seen(residual))

    def linearise(self, unknowns: np.ndarray, free: Sequence[int]) -> Linearisation:
        """Sums of the residuals and of their forward differences, block by block of one video after the other."""
        residual = self._residual(unknowns)
        key = unknowns.tobytes()
        self._images = {key: residual}  # where the fit stands; the next size of squares begins here
        if key not in self._columns:
            self._columns = {key: self._constant_columns(unknowns, residual)}
        curvatures, scores, k, seen = [], [], len(unknowns), self._seen(residual)
        for at, r in enumerate(seen):
            columns = self._columns_of(at)
            own = [i for i in free if i in columns]
            J = torch.stack([in_blocks(self._averaged(at, columns[i])) for i in own], dim=-1).double()
            blocks = in_blocks(r).double()
            curvatures.append(np.zeros((len(J), k, k)))
            scores.append(np.zeros((len(J), k)))
            curvatures[at][:, np.array(own)[:, None], own] = (J.mT @ J).cpu().numpy()
            scores[at][:, own] = (J.mT @ blocks[..., None])[..., 0].cpu().numpy()
        cost = self._cost(residual)
        # Weights make the sum of squares that of as many residuals a video as the first one has.
        first = sum(r.numel() for r, (v, *_) in zip(seen, self._places, strict=True) if v == 0)
        count = len(self.videos) * first
        return Linearisation(
            np.concatenate(curvatures), np.concatenate(scores), cost, math.sqrt(cost / count)
        )

    def _columns_of(self, at: int) -> dict[int, Tensor]:
        """Derivatives of an observation's residuals by the unknowns of its video, where the fit stands."""
        (by_constants,), (v, k, rows) = self._columns.values(), self._places[at]
        own = zip(self._unsure(v), [each[k] for each in self.videos[v].by_deviation or ()], strict=False)
        return {i: column[:rows] for i, column in (*enumerate(c[at] for c in by_constants), *own)}

    def _slope(self, v: int, residual: Sequence[Tensor]) -> np.ndarray:
        """J^T r of another residual of a video, shape (k,)."""
        slope = np.zeros(len(self._u))
        for at, (video, k, rows) in enumerate(self._places):
            if video == v:
                seen = self._averaged(at, residual[k][:rows]).double()
                for i, column in self._columns_of(at).items():
                    slope[i] += float((self._averaged(at, column) * seen).sum())
        return slope

    def _thrown(self, v: int, stds: np.ndarray) -> InitialMotion:
        """The fitted throw of a video; standard deviations of all unknowns are given."""
        motion, throw = self._own(v)[:MOTION], self.videos[v].throw
        return replace(throw.moved(self._u[motion]), std=throw.std * stds[motion])

    def _constant_columns(self, unknowns: np.ndarray, residual: Sequence[Tensor]) -> list[list[Tensor]]:
        """Differences by the constants: forward, and backward where there is no forward: a divergence, or the stiffest
        that dt bears, which the last step may have passed."""
        here, h = self._values(unknowns), self.settings.difference
        columns = [[torch.zeros_like(r) for r in residual]] * self._constants
        missing = range(self._constants)
        for step in (h, -h, -h - self.settings.longest_step):
            moved = {k: unknowns + step * np.eye(len(unknowns))[k] for k in missing}
            moved = {k: point for k, point in moved.items() if self._values(point) != here}
            for k, there in zip(moved, self._simulate(list(moved.values())), strict=True):
                if there is not None:
                    columns[k] = [(t - r) / step for t, r in zip(there, residual, strict=True)]
                    missing = [other for other in missing if other != k]
            if not missing:
                break
        return columns

    @property
    def _spreads(self) -> np.ndarray:
        """Expected distance of the unknowns from 0."""
        deviations = np.ones(NUISANCES * len(self.videos))
        return np.append(np.full(self._constants, self.settings.spread), deviations)

    def _held(self, fit: Linearisation) -> np.ndarray:
        """Curvature that holds every unknown at 0 +- its spread; blocks of all videos count as one residual each."""
        return np.diag(fit.block_cost / len(self.videos) / self._spreads**2)

    def _values(self, unknowns: np.ndarray) -> Values:
        constants = self._origin + unknowns[: self._constants]
        density = min(video.density for video in self.videos)
        return self.family.values(constants, self.videos[0].model, density)

    def _residual(self, unknowns: np.ndarray) -> list[Tensor] | None:
        key = unknowns.tobytes()
        if key not in self._images:
            # What was tried before is not accepted and never comes back.
            (found,) = self._simulate([unknowns])
            self._images = dict([*list(self._images.items())[:1], (key, found)])
        return self._images[key]

    def _simulate(
        self, points: Sequence[np.ndarray], counts: Sequence[int] | None = None
    ) -> list[list[Tensor] | None]:
        """Residuals of the videos at unknowns, of the frames that are fitted or of so many; None where one diverges."""
        if not points:  # all differences of a step led to where dt bears no more stiffness
            return []
        self.rollouts += len(points) * len(self.videos)
        laws = [self.family.law_spec(self._values(point)) for point in points]
        found = [
            video.residuals([Try(law, p[self._own(v)]) for law, p in zip(laws, points, strict=True)], count)
            for v, (video, count) in enumerate(zip(self.videos, counts or self.counts, strict=True))
        ]
        return [
            None if any(r is None for r in of_all) else [r for own in of_all for r in own]
            for of_all in zip(*found, strict=True)
        ]

    def _seen(self, residual: Sequence[Tensor]) -> list[Tensor]:
        return [self._averaged(at, r) for at, r in enumerate(residual)]

    def _averaged(self, at: int, images: Tensor) -> Tensor:
        return averaged(images, self.videos[self._places[at][0]].sizes[self._level])

    def _held_out(self) -> float:
        """Mean squared residual of the frames after those that are fitted; infinite if a rollout diverges there."""
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
