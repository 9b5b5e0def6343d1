"""Images of a thrown body beside those of a video: the residuals that constants are found by.

What is tried is a law, and how far the throw and the place of the rendered body are from what is known of them. A body
of few particles, each at random in its cell, moves as if its material were another: what many particles change in the
images is added to those of the few.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.model import MPM
from neuma_lib.sim.state import Trajectory
from neuma_lib.splatting.observation import Observation, joint_frames, rendered_steps, several

MOTION = 6
"""Unknowns of a throw: velocity and spin."""
NUISANCES = 9
"""These, and of the rendered body: shift right and down, enlargement."""


@dataclass(frozen=True)
class Try:
    """What is simulated and rendered.

    Attributes:
        law: specification.
        deviations: of the throw from what is known of it, along velocity and spin, in standard deviations; then of the
            rendered body to the right, down and in size, in the setting ``pose_tolerance``; shape (9,).
    """

    law: Mapping[str, Mapping[str, Any]]
    deviations: np.ndarray


class ThrownVideo:
    """Simulated minus observed images, averaged over the finest squares.

    Cameras may have other times, sizes and exposures: every step at which some camera has a picture that is compared is
    a frame then, and residuals are lists, an entry for each observation.

    Attributes:
        frames: steps of the frames that are compared.
        fitted: the number of those that families are fitted to; the others judge them.
        weight: factor on all residuals.
        unsure: places of the deviations that are not known to be 0.
        by_deviation: derivatives of the residuals of all frames with respect to the deviations; None: not taken yet.
            All families share those of one that fits: they are mostly kinematics.
        spread: how residuals of all frames differ between two fillings with many particles; None: not known.
        rollouts: simulations so far.
    """

    def __init__(
        self,
        model: MPM,
        throw: InitialMotion,
        body: Reconstruction,
        video: Observation | Sequence[Observation],
        settings: IdentifyConfig,
        finer: Sequence[Reconstruction] = (),
    ):
        seen = [each.select(spread_frames(len(each.frames), settings.frames)) for each in several(video)]
        self.model, self.throw, self.frames, self.weight = model, throw, joint_frames(seen), 1.0
        self.fitted = len(self.frames)
        self.density = float((body.mass / body.vol0).min())
        self.unsure = np.flatnonzero([*throw.std, *[settings.pose_tolerance] * (NUISANCES - MOTION)]).tolist()
        self.by_deviation: list[list[Tensor]] | None = None
        self.spread: list[Tensor] | None = None
        self.rollouts = 0
        self._added: list[Tensor] | None = None
        self._misplaced = settings.pose_tolerance
        self._total, self._axes = settings.covariance_from == "total", seen[0].cameras.viewmats[0, :3, :3]
        self._steps, self._own_frames = rendered_steps(seen), [each.frames for each in seen]
        self._last = [  # step at which the last exposure of the frames up to each ends
            max(f + each.exposure[-1] for each in seen for f in each.frames if f <= n) for n in self.frames
        ]

        def films(body: Reconstruction) -> list[Filmed]:
            return [
                Filmed(body.particle_gs(each.cameras), each, self._steps, settings.compare) for each in seen
            ]

        self._body, *self._finer = [(each, films(each)) for each in (body, *finer)]
        sizes = [[max(1, round(each.cameras.width / across)) for across in settings.pyramid] for each in seen]
        self._finest = [each[-1] for each in sizes]
        self.sizes = [max(1, round(size / self._finest[0])) for size in sizes[0]]
        """Edge of each round's squares in squares of the finest ones."""
        self._observed = [
            torch.cat([
                averaged(each.colours(part) if settings.compare == "colour" else each.coverage(part), size)
                for part in frame_batches(len(each.frames), filmed.batch)
            ])
            for each, filmed, size in zip(seen, self._body[1], self._finest, strict=True)
        ]  # fmt: skip

    def counts(self, frames: int) -> list[int]:
        """How many frames of each observation are among the first ones of all."""
        if frames == 0:
            return [0] * len(self._own_frames)
        return [bisect_right(own, self.frames[frames - 1]) for own in self._own_frames]

    @property
    def fitted_pixels(self) -> int:
        counts = self.counts(self.fitted)
        return sum(seen[:count].numel() for seen, count in zip(self._observed, counts, strict=True))

    def hold_out(self, family: Family, share: float) -> None:
        """Leave a share of the frames after the first contact, the last ones, to judge by; any law falls alike."""
        law = family.law_spec(family.values(family.unbounded(family.guess), self.model, self.density))
        (path,) = self._paths([Try(law, np.zeros(NUISANCES))], len(self.frames), self._body[0])
        contact = 0 if path is None else first_contact(self.model, path.at(self.frames).x)
        self.fitted = held_out_frames(len(self.frames), share, contact=contact)[0]

    def residuals(self, tries: Sequence[Try], count: int) -> list[list[Tensor] | None]:
        """Residuals (T, V, H', W', C) of the first frames for each try; None where the rollout diverges."""
        paths = self._paths(tries, count, self._body[0])
        found = [
            self._residual(one, path, self._body[1], count) for one, path in zip(tries, paths, strict=True)
        ]
        if self._added is None:
            return found
        return [
            None if one is None else [r + a[: len(r)] for r, a in zip(one, self._added, strict=True)]
            for one in found
        ]

    def differentiate(self, here: Try) -> None:
        """Take the derivatives by the deviations there: forward differences, 0 where a rollout diverges."""
        moved = [replace(here, deviations=here.deviations + step) for step in np.eye(NUISANCES)[self.unsure]]
        flown = [here, *(one for one, k in zip(moved, self.unsure, strict=True) if k < MOTION)]
        count = len(self.frames)
        paths = self._paths(flown, count, self._body[0])
        # What only moves the rendered body needs no rollout.
        paths += [paths[0]] * (1 + len(moved) - len(flown))
        base, *there = (
            self._residual(one, path, self._body[1], count)
            for one, path in zip([here, *moved], paths, strict=True)
        )
        if base is not None:  # it held for the frames that are fitted
            self.by_deviation = [
                [torch.zeros_like(r) for r in base] if each is None else _differences(each, base)
                for each in there
            ]

    def refine_particles(self, here: Try) -> None:
        """Add what more particles change in the images to all residuals from now on, and know how sure that is."""
        if not self._finer:
            return
        coarse, *fine = (
            self._residual(here, self._paths([here], len(self.frames), body)[0], filmed, len(self.frames))
            for body, filmed in (self._body, *self._finer)
        )
        fine = [residual for residual in fine if residual is not None]
        if coarse is not None and fine:
            means = [torch.stack(of_all).mean(0) for of_all in zip(*fine, strict=True)]
            self._added = _differences(means, coarse)
            self.spread = _differences(fine[0], fine[-1]) if len(fine) > 1 else None

    def _paths(self, tries: Sequence[Try], count: int, body: Reconstruction) -> list[Trajectory | None]:
        """Rollouts over what the first frames need, and what lies between."""
        self.rollouts += len(tries)
        frames = self._steps[: bisect_right(self._steps, self._last[count - 1])]
        starts = [self.throw.moved(one.deviations[:MOTION]).of_body(body) for one in tries]
        laws = [analytic_law(one.law, self.model.dt).to(starts[0].x.device) for one in tries]
        options = dict(steps=frames[-1], frames=frames, total=self._total)
        return rollout_batch(self.model, laws, starts, **options)

    @torch.no_grad()
    def _residual(
        self, one: Try, path: Trajectory | None, filmed: Sequence[Filmed], count: int
    ) -> list[Tensor] | None:
        if path is None:
            return None
        right, down, enlargement = (self._misplaced * one.deviations[MOTION:]).tolist()
        found = []
        for films, seen, size, T in zip(
            filmed, self._observed, self._finest, self.counts(count), strict=True
        ):
            images = []
            for part in frame_batches(T, films.batch) if T else ():
                x = films.states(path.x, part)
                centre = x.mean(dim=-2, keepdim=True)
                x = centre + (1 + enlargement) * (x - centre)
                x = x + right * self._axes[0] + down * self._axes[1]
                images.append(averaged(films(x, (1 + enlargement) * films.states(path.stretch, part)), size))
            found.append(self.weight * (torch.cat([*images, seen[:0]]) - seen[:T]))
        return found if all(bool(residual.isfinite().all()) for residual in found) else None


def _differences(these: Sequence[Tensor], those: Sequence[Tensor]) -> list[Tensor]:
    return [this - that for this, that in zip(these, those, strict=True)]


def averaged(images: Tensor, size: int) -> Tensor:
    """Images (T, V, H, W, C) averaged over squares of ``size`` pixels, those at the far edges over what is there."""
    if size == 1 or not len(images):
        return images
    T, V = images.shape[:2]
    flat = images.flatten(0, 1).movedim(-1, 1)
    pooled = torch.nn.functional.avg_pool2d(flat, size, ceil_mode=True, count_include_pad=False)
    return pooled.movedim(1, -1).unflatten(0, (T, V))
