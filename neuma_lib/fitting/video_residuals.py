"""Residuals between simulated and observed images of a launched body, from which constants are identified.

A candidate is a law with deviations of the initial motion and of the position of the rendered body from their
estimates. A coarse grid and few particles change the apparent material, so a second discretisation, with a finer grid,
shorter time steps and more particles, may be simulated instead.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.coupling.filmed import Filmed
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.fitting.families import Family
from neuma_lib.fitting.frame_batches import first_contact, frame_batches, held_out_frames, spread_frames
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rigid_flight import is_rigid, rigid_flight
from neuma_lib.sim.state import State, Trajectory
from neuma_lib.splatting.observation import Observation, joint_frames, rendered_steps, several
from neuma_lib.threads import in_threads

MOTION = 6
"""Number of unknowns of an initial motion: velocity and spin."""
NUISANCES = 9
"""`MOTION`, and shift right, shift down and enlargement of the rendered body."""
_KEPT = 4  # flights of different motions, and their images


@dataclass(frozen=True)
class Candidate:
    """Parameters of a simulation and its rendering.

    Attributes:
        law: specification of the law.
        deviations: deviations (9,) of velocity and spin from their estimates in standard deviations, then shift right,
            shift down and enlargement of the rendered body in units of the setting ``pose_tolerance``.
        friction: Coulomb coefficient of all obstacles. None: those of the model.
    """

    law: Mapping[str, Mapping[str, Any]]
    deviations: np.ndarray
    friction: float | None = None


@dataclass
class _Discretisation:
    """Grid, time step and particles of simulations, and what renders them."""

    model: MPM
    body: Reconstruction
    films: list[Filmed]
    kernels: object = field(default_factory=object)  # key of `in_threads`


def finer(model: MPM, refinement: float, steps: Sequence[int]) -> MPM:
    """The model with ``refinement`` times as many cells along an edge and at least as many times the time steps.

    Steps of the model at ``steps`` are whole numbers of its steps.
    """
    between = math.gcd(*steps) or 1
    return replace(
        model,
        grid=round(refinement * model.grid),
        dt=model.dt * between / math.ceil(refinement * between - 1e-9),
    )


class VideoResiduals:
    """Simulated minus observed images, averaged over the squares of the finest level.

    If cameras differ in times, sizes or exposures, every step with a compared image of some camera is a frame.
    Residuals are lists with one entry per observation.

    Attributes:
        frames: steps of the compared frames.
        fitted: number of leading frames for the fit; the others are held out.
        weight: factor on all residuals.
        unsure: indices of the deviations that are not fixed to 0.
        by_deviation: derivatives of the residuals of all frames with respect to these deviations, or None if not
            computed. All families share those of one family, because they are mostly kinematic.
        rollouts: number of simulations.
    """

    def __init__(
        self,
        model: MPM,
        motion: InitialMotion,
        body: Reconstruction,
        video: Observation | Sequence[Observation],
        settings: IdentifyConfig,
        refined: Reconstruction | None = None,
    ):
        observed = [each.select(spread_frames(len(each.frames), settings.frames)) for each in several(video)]
        self.model, self.motion, self.frames, self.weight = model, motion, joint_frames(observed), 1.0
        self.fitted = len(self.frames)
        self.density = float((body.mass / body.vol0).min())
        self.unsure = np.flatnonzero(
            [*motion.std, *[settings.pose_tolerance] * (NUISANCES - MOTION)]
        ).tolist()
        self.by_deviation: list[list[Tensor]] | None = None
        self.rollouts = 0
        self._pose_tolerance = settings.pose_tolerance
        self._total, self._axes = settings.covariance_from == "total", observed[0].cameras.viewmats[0, :3, :3]
        self._steps, self._own_frames = rendered_steps(observed), [each.frames for each in observed]
        self._ends = [[f + each.exposure[-1] for f in each.frames] for each in observed]
        self._flights: dict[tuple[bool, bytes], Trajectory] = {}
        self._flown: dict[tuple[bool, bytes, int, int], Tensor] = {}
        self._last = [  # step at which the last exposure of the frames up to each ends
            max(
                ends[bisect_right(each.frames, n) - 1]
                for each, ends in zip(observed, self._ends, strict=True)
                if each.frames[0] <= n
            )
            for n in self.frames
        ]

        def discretised(by: MPM, body: Reconstruction) -> _Discretisation:
            films = (body.particle_gs(each.cameras) for each in observed)
            options = self._steps, settings.compare
            pairs = zip(films, observed, strict=True)
            return _Discretisation(by, body, [Filmed(own, each, *options) for own, each in pairs])

        self._coarse, self._fine = discretised(model, body), None
        if refined is not None:
            self._fine = discretised(finer(model, settings.refinement, self._steps), refined)
        sizes = [
            [max(1, round(each.cameras.width / across)) for across in settings.pyramid] for each in observed
        ]
        self._finest = [each[-1] for each in sizes]
        self.sizes = [max(1, round(size / self._finest[0])) for size in sizes[0]]
        """Side of the squares of each level in squares of the finest level."""
        self._observed = [
            torch.cat([
                averaged(each.colours(part) if settings.compare == "colour" else each.coverage(part), size)
                for part in frame_batches(len(each.frames), filmed.batch)
            ])
            for each, filmed, size in zip(observed, self._coarse.films, self._finest, strict=True)
        ]  # fmt: skip

    def observe(self, candidate: Candidate) -> bool:
        """Replace the observed images by those of a candidate. Returns False if its rollout diverges."""
        (residual,) = self.residuals([candidate], len(self.frames))
        if residual is not None:
            pairs = zip(residual, self._observed, strict=True)
            self._observed = [own / self.weight + images for own, images in pairs]
        return residual is not None

    def set_friction(self, friction: float) -> None:
        """Set the Coulomb coefficient of all obstacles in the simulations that follow."""
        self.model = self.model.with_friction(friction)
        for each in filter(None, (self._coarse, self._fine)):
            each.model = each.model.with_friction(friction)

    def counts(self, frames: int) -> list[int]:
        """Number of frames of each observation among the first ``frames`` of all."""
        if frames == 0:
            return [0] * len(self._own_frames)
        return [bisect_right(own, self.frames[frames - 1]) for own in self._own_frames]

    @property
    def fitted_pixels(self) -> int:
        counts = self.counts(self.fitted)
        return sum(images[:count].numel() for images, count in zip(self._observed, counts, strict=True))

    def hold_out(self, family: Family, share: float) -> None:
        """Hold out the last share of the frames after the first contact, whose time is the same for any law, or of all
        frames of a clamped body."""
        law = family.law_spec(family.values(family.unbounded(family.guess), self.model, self.density))
        (path,), _ = self._paths([Candidate(law, np.zeros(NUISANCES))], len(self.frames), self._coarse)
        vol0 = self._coarse.body.vol0
        free = path is not None and not self.model.clamps
        contact = 0 if not free else first_contact(self.model, path.at(self.frames).x, vol0, self.frames)
        self.fitted = held_out_frames(len(self.frames), share, contact=contact)[0]

    def residuals(
        self, candidates: Sequence[Candidate], count: int, fine: bool = False
    ) -> list[list[Tensor] | None]:
        """Residuals (T, V, H', W', C) of the first ``count`` frames per candidate, None if its rollout diverges.

        Args:
            fine: simulate the refined body on the finer grid.
        """
        on = self._fine if fine else self._coarse
        return self._residuals(candidates, *self._paths(candidates, count, on), on, count)

    def differentiate(self, at: Candidate) -> None:
        """Compute the derivatives by the deviations as forward differences, 0 where a rollout diverges."""
        varied = [replace(at, deviations=at.deviations + step) for step in np.eye(NUISANCES)[self.unsure]]
        simulated = [at, *(one for one, k in zip(varied, self.unsure, strict=True) if k < MOTION)]
        count = len(self.frames)
        paths, flown = self._paths(simulated, count, self._coarse)
        # Shift and enlargement of the rendered body need no rollout.
        more = 1 + len(varied) - len(simulated)
        paths, flown = paths + paths[:1] * more, flown + flown[:1] * more
        base, *others = self._residuals([at, *varied], paths, flown, self._coarse, count)
        if base is not None:  # otherwise it diverges after the fitted frames
            self.by_deviation = [
                [torch.zeros_like(r) for r in base] if each is None else _differences(each, base)
                for each in others
            ]

    def _paths(
        self, candidates: Sequence[Candidate], count: int, on: _Discretisation
    ) -> tuple[list[Trajectory | None], list[int]]:
        """Rollouts to the end of the exposure of the first ``count`` frames, which are steps of the coarse grid, and
        the number of their states in rigid flight."""
        self.rollouts += len(candidates)
        frames = self._steps[: bisect_right(self._steps, self._last[count - 1])]
        starts = [self.motion.moved(one.deviations[:MOTION]).of_body(on.body) for one in candidates]
        laws = [analytic_law(one.law, on.model.dt).to(starts[0].x.device) for one in candidates]
        models = [
            on.model if one.friction is None else on.model.with_friction(one.friction) for one in candidates
        ]
        flights = [self._flight(on, *each) for each in zip(candidates, laws, starts, strict=True)]
        paths: list[Trajectory | None] = [None] * len(candidates)
        for flown in {len(flight.frames) for flight in flights}:
            own = [i for i, flight in enumerate(flights) if len(flight.frames) == flown]
            flown = min(flown, len(frames) - 1)
            first = frames[flown - 1] if flown else 0
            later = self._steps_of(on, (n - first for n in frames[flown:]))
            simulated = rollout_batch(
                [models[i] for i in own],
                [laws[i] for i in own],
                [starts[i].after(flights[i], flown - 1) if flown else starts[i] for i in own],
                steps=later[-1],
                frames=later,
                total=self._total,
            )
            for i, path in zip(own, simulated, strict=True):
                path = path and replace(path, frames=tuple(frames[flown:]))
                paths[i] = flights[i].first(flown).followed_by(path) if path and flown else path
        return paths, [len(flight.frames) for flight in flights]

    def _steps_of(self, on: _Discretisation, steps: Iterable[int]) -> list[int]:
        """Steps of a discretisation at the times of steps of the model."""
        return [round(n * self.model.dt / on.model.dt) for n in steps]

    def _flight(self, on: _Discretisation, one: Candidate, law: Law, start: State) -> Trajectory:
        """States before the first contact of a spinning body that its law keeps rigid, without frames if there are
        none."""
        key = (on is self._fine, one.deviations[:MOTION].tobytes())
        if key not in self._flights:
            flight = rigid_flight(on.model, start, self._steps_of(on, self._steps), self._total)
            clear = first_contact(on.model, flight.x, start.vol0, flight.frames)
            flight = replace(flight, frames=self._steps)
            self._flights = {**dict(list(self._flights.items())[-_KEPT:]), key: flight.first(clear)}
        changes = on.model.changes or on.model.clamps
        rigid = start.C.any() and not changes and is_rigid(law, start)
        return self._flights[key].first(len(self._steps) if rigid else 0)

    def _residuals(
        self,
        candidates: Sequence[Candidate],
        paths: Sequence[Trajectory | None],
        flown: Sequence[int],
        on: _Discretisation,
        count: int,
    ) -> list[list[Tensor] | None]:
        """Residuals of the candidates, on a CPU in threads, with the same results for any number."""

        def residual(each: tuple[Candidate, Trajectory | None, int]) -> list[Tensor] | None:
            return self._residual(*each, on, count)

        threads = None if on.body.x0.device.type == "cpu" else 1
        items = list(zip(candidates, paths, flown, strict=True))
        return in_threads(residual, items, [on.kernels] * len(items), threads)

    @torch.no_grad()
    def _residual(
        self, one: Candidate, path: Trajectory | None, flown: int, on: _Discretisation, count: int
    ) -> list[Tensor] | None:
        """Residuals of a candidate. Images of rigid flight are kept, because they are the same for all laws."""
        if path is None:
            return None
        right, down, enlargement = (self._pose_tolerance * one.deviations[MOTION:]).tolist()
        residuals, counts = [], self.counts(count)
        for k, (films, observed, size) in enumerate(zip(on.films, self._observed, self._finest, strict=True)):
            first = min(bisect_right(self._ends[k], self._steps[flown - 1]), counts[k]) if flown else 0
            key = (on is self._fine, one.deviations.tobytes(), k, first)
            images = [self._flown[key]] if key in self._flown else []
            parts = [] if images else [*_parts(0, first, films.batch)]
            for part in [*parts, *_parts(first, counts[k], films.batch)]:
                x = films.states(path.x, part)
                centre = x.mean(dim=-2, keepdim=True)
                x = centre + (1 + enlargement) * (x - centre)
                x = x + right * self._axes[0] + down * self._axes[1]
                images.append(averaged(films(x, (1 + enlargement) * films.states(path.stretch, part)), size))
            if parts:
                kept = {key: torch.cat(images[: len(parts)])}
                self._flown = {**dict(list(self._flown.items())[-_KEPT:]), **kept}
            residuals.append(self.weight * (torch.cat([*images, observed[:0]]) - observed[: counts[k]]))
        return residuals if all(bool(residual.isfinite().all()) for residual in residuals) else None


def _parts(first: int, last: int, size: int) -> Iterator[slice]:
    """Batches of at most ``size`` of the frames from ``first`` up to ``last``."""
    if first < last:
        for part in frame_batches(last - first, size):
            yield slice(first + part.start, first + part.stop)


def _differences(these: Sequence[Tensor], those: Sequence[Tensor]) -> list[Tensor]:
    return [this - that for this, that in zip(these, those, strict=True)]


def averaged(images: Tensor, size: int) -> Tensor:
    """Images (T, V, H, W, C) averaged over squares of ``size`` pixels, which are cut off at the far edges."""
    if size == 1 or not len(images):
        return images
    T, V = images.shape[:2]
    flat = images.flatten(0, 1).movedim(-1, 1)
    pooled = torch.nn.functional.avg_pool2d(flat, size, ceil_mode=True, count_include_pad=False)
    return pooled.movedim(1, -1).unflatten(0, (T, V))
