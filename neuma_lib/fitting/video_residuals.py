"""Residuals between simulated and observed images of launched bodies, from which constants are identified.

A candidate is a law of each body with deviations of its initial motion and of the position of the rendered body from
their estimates. Several bodies touch each other with frictions of their pairs. A coarse grid and few particles change
the apparent material, so a second discretisation, with a finer grid, shorter time steps and more particles, may be
simulated instead.
"""

import math
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.coupling.bodies import join
from neuma_lib.coupling.filmed import Filmed
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.fitting.families import Bodies, Family
from neuma_lib.fitting.frame_batches import first_contact, frame_batches, held_out_frames, spread_frames
from neuma_lib.fitting.least_squares import MIN_COST
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.model import MPM, consecutive, with_fields
from neuma_lib.sim.rigid_flight import is_rigid, rigid_flight
from neuma_lib.sim.state import State, Trajectory
from neuma_lib.splatting.observation import Observation, joint_frames, rendered_steps, several
from neuma_lib.splatting.spherical_harmonics import rgb_to_sh0
from neuma_lib.threads import in_threads

MOTION = 6  # number of unknowns of an initial motion: velocity and spin
NUISANCES = 9  # `MOTION`, and shift right, shift down and enlargement of the rendered body, for each body
COARSER = 1.5  # ratio of the cell sizes whose images are compared
_MAX_NOISE = 1e4  # of a video whose simulation on the coarser grid diverges, so that its weight is not 0
_KEPT = 4  # flights of different motions, and their images


@dataclass(frozen=True)
class Candidate:
    """Parameters of a simulation and its rendering.

    Attributes:
        law: specification of the law, or of the laws of several bodies.
        deviations: deviations (9 times the bodies,) of velocity and spin from their estimates in standard deviations,
            then shift right, shift down and enlargement of the rendered body in units of the setting
            ``pose_tolerance``.
        friction: Coulomb coefficient of all obstacles. None: those of the model.
        pairs: Coulomb coefficients of the pairs of the model. None: those of the model.
    """

    law: Mapping[str, Any] | Sequence[Mapping[str, Any]]
    deviations: np.ndarray
    friction: float | None = None
    pairs: Sequence[float] | None = None

    @property
    def laws(self) -> Sequence[Mapping[str, Any]]:
        return [self.law] if isinstance(self.law, Mapping) else self.law

    def on(self, model: MPM) -> MPM:
        """The model with its frictions."""
        model = model if self.friction is None else model.with_friction(self.friction)
        return model if self.pairs is None else model.with_pair_frictions(self.pairs)


@dataclass
class _Discretisation:
    """Grid, time step and particles of simulations, and what renders them."""

    model: MPM
    bodies: Sequence[Reconstruction]
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
        noise: variance of the residuals relative to that of a first video, by which `weigh` has lowered the weight.
        unsure: indices of the deviations that are not fixed to 0.
        by_deviation: derivatives of the residuals of all frames with respect to these deviations, or None if not
            computed. All families share those of one family, because they are mostly kinematic.
        rollouts: number of simulations.
    """

    def __init__(
        self,
        model: MPM,
        motion: InitialMotion | Sequence[InitialMotion],
        body: Reconstruction | Sequence[Reconstruction],
        video: Observation | Sequence[Observation],
        settings: IdentifyConfig,
        refined: Reconstruction | None = None,
    ):
        self.motions = [motion] if isinstance(motion, InitialMotion) else list(motion)
        bodies = [body] if isinstance(body, Reconstruction) else list(body)
        observed = [each.select(spread_frames(len(each.frames), settings.frames)) for each in several(video)]
        self.model, self.frames, self.weight, self.noise = model, joint_frames(observed), 1.0, 1.0
        self.fitted = len(self.frames)
        self.density = min(float((body.mass / body.vol0).min()) for body in bodies)
        tolerances = [settings.pose_tolerance] * (NUISANCES - MOTION)
        self.unsure = np.flatnonzero([[*own.std, *tolerances] for own in self.motions]).tolist()
        self.by_deviation: list[list[Tensor]] | None = None
        self.rollouts = 0
        self._pose_tolerance = settings.pose_tolerance
        self._total, self._axes = settings.covariance_from == "total", observed[0].cameras.viewmats[0, :3, :3]
        self._steps, self._own_frames = rendered_steps(observed), [each.frames for each in observed]
        self._ends = [[f + each.exposure[-1] for f in each.frames] for each in observed]
        self._flights: dict[tuple[bool, int, bytes], Trajectory] = {}
        self._flown: dict[tuple[bool, bytes, int, int], Tensor] = {}
        self._last = [  # step at which the last exposure of the frames up to each ends
            max(
                ends[bisect_right(each.frames, n) - 1]
                for each, ends in zip(observed, self._ends, strict=True)
                if each.frames[0] <= n
            )
            for n in self.frames
        ]

        def discretised(by: MPM, bodies: Sequence[Reconstruction]) -> _Discretisation:
            films = (join(bodies).particle_gs(each.cameras) for each in observed)
            options = self._steps, settings.compare
            pairs = zip(films, observed, strict=True)
            return _Discretisation(by, bodies, [Filmed(own, each, *options) for own, each in pairs])

        self._coarse, self._fine = discretised(model, bodies), None
        if refined is not None:
            self._fine = discretised(finer(model, settings.refinement, self._steps), [refined])
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

    def coarser_difference(self, at: Candidate, ratio: float) -> float:
        """Mean squared difference between the images of a candidate and those with ``ratio`` times the cell size,
        infinite if a rollout diverges."""
        on = replace(self._coarse, model=replace(self._coarse.model, grid=round(self.model.grid / ratio)))
        count = len(self.frames)
        (own,) = self.residuals([at], count)
        (other,) = self._residuals([at], *self._paths([at], count, on), on, count)
        if own is None or other is None:
            return math.inf
        changes = torch.cat([change.flatten() for change in _differences(other, own)])
        return float(changes.double().square().mean()) / self.weight**2

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

    @property
    def deviations(self) -> int:
        """Number of deviations of a candidate."""
        return NUISANCES * len(self.motions)

    @property
    def particles(self) -> list[int]:
        """Number of particles of each body."""
        return [len(body.x0) for body in self._coarse.bodies]

    def hold_out(self, family: Family | Bodies, share: float) -> None:
        """Hold out the last share of the frames after the first contact, whose time is the same for any law, or of all
        frames of a clamped body."""
        values = family.values(family.unbounded(family.guess), self.model, self.density)
        one = Candidate(family.law_spec(values), np.zeros(self.deviations))
        (path,), _ = self._paths([one], len(self.frames), self._coarse)
        contact = 0
        if path is not None and not self.model.clamps:
            x = path.at(self.frames).x.split(self.particles, dim=1)
            bodies = zip(x, self._coarse.bodies, strict=True)
            contact = min(first_contact(self.model, own, body.vol0, self.frames) for own, body in bodies)
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

    @torch.no_grad()
    def hidden_shares(self, one: Candidate) -> Tensor:
        """Share of each body that the others hide in the images of each frame, (T, bodies), in [0, 1].

        Coverages are summed over pixels and cameras, without blur and the deviations of the rendered bodies. NaN where
        a body is in no image, or the rollout diverges.
        """
        (path,), _ = self._paths([one], len(self.frames), self._coarse)
        bodies, whole = self._coarse.bodies, join(self._coarse.bodies)
        alone, visible = torch.zeros(2, len(self.frames), len(bodies), dtype=torch.float64)
        for film, frames in zip(self._coarse.films, self._own_frames, strict=True) if path else ():
            renderers = []
            for k, body in enumerate(bodies):
                # Its Gaussians in black, those of the others in the white of the background.
                colours = [torch.full_like(each.gaussians.sh0, j != k) for j, each in enumerate(bodies)]
                drawn = replace(
                    whole.gaussians, sh0=rgb_to_sh0(torch.cat(colours)), shN=whole.gaussians.shN[:, :0]
                )
                cameras = film.renderer.cameras
                both = body.particle_gs(cameras), replace(whole, gaussians=drawn).particle_gs(cameras)
                renderers.append(both)
            for part in frame_batches(len(frames), film.batch):
                states, rows = path.at(frames[part]), [self.frames.index(n) for n in frames[part]]
                x, F = states.x, states.stretch
                own = zip(x.split(self.particles, dim=1), F.split(self.particles, dim=1), strict=True)
                for k, ((single, shown), body) in enumerate(zip(renderers, own, strict=True)):
                    alone[rows, k] += _sums(single.coverage(*body))
                    visible[rows, k] += _sums(1 - shown(x, F)[..., :1])
        return (1 - visible / alone).clamp(0, 1)

    def differentiate(self, at: Candidate) -> None:
        """Compute the derivatives by the deviations as forward differences, 0 where a rollout diverges."""
        # Shift and enlargement of the rendered body need no rollout.
        order = sorted(self.unsure, key=lambda k: k % NUISANCES >= MOTION)
        moved = sum(k % NUISANCES < MOTION for k in order)
        varied = [replace(at, deviations=at.deviations + np.eye(self.deviations)[k]) for k in order]
        count, more = len(self.frames), len(order) - moved
        paths, flown = self._paths([at, *varied[:moved]], count, self._coarse)
        paths, flown = paths + paths[:1] * more, flown + flown[:1] * more
        base, *others = self._residuals([at, *varied], paths, flown, self._coarse, count)
        others = [others[order.index(k)] for k in self.unsure]
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
        device, models = on.bodies[0].x0.device, [one.on(on.model) for one in candidates]
        laws = [[analytic_law(law, on.model.dt).to(device) for law in one.laws] for one in candidates]
        starts = [self._start(on, *each) for each in zip(candidates, laws, strict=True)]
        flights = [self._flight(on, *each) for each in zip(candidates, laws, starts, strict=True)]
        paths: list[Trajectory | None] = [None] * len(candidates)
        for flown in {len(flight.frames) for flight in flights}:
            own = [i for i, flight in enumerate(flights) if len(flight.frames) == flown]
            flown = min(flown, len(frames) - 1)
            first = frames[flown - 1] if flown else 0
            later = self._steps_of(on, (n - first for n in frames[flown:]))
            simulated = rollout_batch(
                [models[i] for i in own],
                [laws[i] if len(laws[i]) > 1 else laws[i][0] for i in own],
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

    def _start(self, on: _Discretisation, one: Candidate, laws: Sequence[Law]) -> State:
        """Initial state of a candidate."""
        deviations = one.deviations.reshape(-1, NUISANCES)[:, :MOTION]
        bodies = zip(self.motions, deviations, on.bodies, strict=True)
        states = [motion.moved(own).of_body(body) for motion, own, body in bodies]
        start = State.joined(states, separate=True) if len(states) > 1 else states[0]
        return with_fields(start, consecutive(laws, [len(state.x) for state in states]))

    def _flight(self, on: _Discretisation, one: Candidate, laws: Sequence[Law], start: State) -> Trajectory:
        """States before the first contact of a spinning body that its law keeps rigid, without frames if there are
        none, as for several bodies."""
        if start.bodies:
            return Trajectory((), *(value[:0, None] for value in start.motion))
        (law,) = laws
        key = (on is self._fine, on.model.grid, one.deviations[:MOTION].tobytes())
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

        threads = None if on.bodies[0].x0.device.type == "cpu" else 1
        items = list(zip(candidates, paths, flown, strict=True))
        return in_threads(residual, items, [on.kernels] * len(items), threads)

    @torch.no_grad()
    def _residual(
        self, one: Candidate, path: Trajectory | None, flown: int, on: _Discretisation, count: int
    ) -> list[Tensor] | None:
        """Residuals of a candidate. Images of rigid flight are kept, because they are the same for all laws."""
        if path is None:
            return None
        poses = (self._pose_tolerance * one.deviations.reshape(-1, NUISANCES)[:, MOTION:]).tolist()
        sizes = [len(body.x0) for body in on.bodies]
        residuals, counts = [], self.counts(count)
        for k, (films, observed, size) in enumerate(zip(on.films, self._observed, self._finest, strict=True)):
            first = min(bisect_right(self._ends[k], self._steps[flown - 1]), counts[k]) if flown else 0
            key = (on is self._fine, one.deviations.tobytes(), k, first)
            images = [self._flown[key]] if key in self._flown else []
            parts = [] if images else [*_parts(0, first, films.batch)]
            for part in [*parts, *_parts(first, counts[k], films.batch)]:
                x = films.states(path.x, part).split(sizes, dim=-2)
                F = films.states(path.stretch, part).split(sizes, dim=-3)
                F = [(1 + enlargement) * own for own, (_, _, enlargement) in zip(F, poses, strict=True)]
                x = [self._posed(own, *pose) for own, pose in zip(x, poses, strict=True)]
                x, F = (
                    x[0] if len(x) == 1 else torch.cat(x, dim=-2),
                    F[0] if len(F) == 1 else torch.cat(F, dim=-3),
                )
                images.append(averaged(films(x, F, part), size))
            if parts:
                kept = {key: torch.cat(images[: len(parts)])}
                self._flown = {**dict(list(self._flown.items())[-_KEPT:]), **kept}
            residuals.append(self.weight * (torch.cat([*images, observed[:0]]) - observed[: counts[k]]))
        return residuals if all(bool(residual.isfinite().all()) for residual in residuals) else None

    def _posed(self, x: Tensor, right: float, down: float, enlargement: float) -> Tensor:
        """Positions (..., N, 3) [m] of a body, enlarged about its centre and shifted in the image."""
        centre = x.mean(dim=-2, keepdim=True)
        x = centre + (1 + enlargement) * (x - centre)
        return x + right * self._axes[0] + down * self._axes[1]


def noise_ratio(difference: float, of_first: float, loss: float) -> float:
    """Variance of the residuals of a video over that of a first one, at least 1 and at most `_MAX_NOISE`.

    The error of the discretisation is part of the residuals. It is larger where a coarser grid changes the images more.

    Args:
        difference: `VideoResiduals.coarser_difference` of the video.
        of_first: that of the first video.
        loss: mean squared residual of the first video.
    """
    excess = difference - of_first
    if not excess > 0:  # or both are infinite
        return 1.0
    return min(1 + excess / max(loss, of_first, MIN_COST), _MAX_NOISE)


def weigh(videos: Sequence[VideoResiduals], at: Candidate, loss: float) -> float:
    """Set the weights of videos: equal for each video with the noise of the first one, however many pixels it has.

    Args:
        videos: of one material, with the fitted frames set.
        at: the law. The motions are those estimated.
        loss: mean squared residual of the first video.

    Returns:
        `VideoResiduals.coarser_difference` of the first video.
    """
    differences = [video.coarser_difference(at, COARSER) for video in videos]
    for video, own in zip(videos, differences, strict=True):
        video.noise = noise_ratio(own, differences[0], loss)
        video.weight = (videos[0].fitted_pixels / video.fitted_pixels / video.noise) ** 0.5
    return differences[0]


def _parts(first: int, last: int, size: int) -> Iterator[slice]:
    """Batches of at most ``size`` of the frames from ``first`` up to ``last``."""
    if first < last:
        for part in frame_batches(last - first, size):
            yield slice(first + part.start, first + part.stop)


def _sums(images: Tensor) -> Tensor:
    """Sums (T,) over the pixels and cameras of images (T, V, H, W, 1)."""
    return images.double().sum(dim=(1, 2, 3, 4)).cpu()


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
