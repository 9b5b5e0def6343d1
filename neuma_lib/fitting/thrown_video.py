"""Images of a thrown body beside those of a video: the residuals that constants are found by.

What is tried is a law, and how far the throw and the place of the rendered body are from what is known of them. A body
of few particles, each at random in its cell, moves as if its material were another: what many particles change in the
images is added to those of the few.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.coupling.particle_gs import ParticleGS
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.fitting.families import Family
from neuma_lib.fitting.frame_batches import first_contact, frame_batches, held_out_frames, spread_frames
from neuma_lib.fitting.throw import Throw
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.model import MPMModel
from neuma_lib.sim.state import Trajectory
from neuma_lib.splatting.observation import Observation

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
            rendered body to the right, down and in size, in the setting ``misplaced``; shape (9,).
    """

    law: Mapping[str, Mapping[str, Any]]
    deviations: np.ndarray


class ThrownVideo:
    """Simulated minus observed images, averaged over the finest squares.

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
        model: MPMModel,
        throw: Throw,
        body: Reconstruction,
        video: Observation,
        settings: IdentifyConfig,
        finer: Sequence[Reconstruction] = (),
    ):
        seen = video.select(spread_frames(len(video.frames), settings.frames))
        self.model, self.throw, self.frames, self.weight = model, throw, seen.frames, 1.0
        self.fitted = len(seen.frames)
        self.density = float((body.mass / body.vol0).min())
        self.unsure = np.flatnonzero([*throw.std, *[settings.misplaced] * (NUISANCES - MOTION)]).tolist()
        self.by_deviation: list[Tensor] | None = None
        self.spread: Tensor | None = None
        self.rollouts = 0
        self._added: Tensor | None = None
        self._misplaced = settings.misplaced
        self._total, self._axes = settings.covariance_from == "total", seen.cameras.viewmats[0, :3, :3]
        self._body, *self._finer = [(each, each.particle_gs(seen.cameras)) for each in (body, *finer)]
        width = seen.cameras.width
        sizes = [max(1, round(width / across)) for across in settings.squares]
        self.finest = sizes[-1]
        self.sizes = [max(1, round(size / self.finest)) for size in sizes]
        """Edge of each round's squares in squares of the finest ones."""
        parts = frame_batches(len(seen.frames), self._body[1].frames_per_batch)
        self._observed = torch.cat([averaged(seen.colours(part), self.finest) for part in parts])

    @property
    def fitted_pixels(self) -> int:
        return self._observed[: self.fitted].numel()

    def hold_out(self, family: Family, share: float) -> None:
        """Leave a share of the frames after the first contact, the last ones, to judge by; any law falls alike."""
        law = family.law_spec(family.values(family.unbounded(family.guess), self.model, self.density))
        (path,) = self._paths([Try(law, np.zeros(NUISANCES))], self.frames, self._body[0])
        contact = 0 if path is None else first_contact(self.model, path.x)
        self.fitted = held_out_frames(len(self.frames), share, contact=contact)[0]

    def residuals(self, tries: Sequence[Try], count: int) -> list[Tensor | None]:
        """Residuals (count, V, H', W', 3) of the first frames for each try; None where the rollout diverges."""
        paths = self._paths(tries, self.frames[:count], self._body[0])
        found = [self._residual(one, path, self._body[1]) for one, path in zip(tries, paths, strict=True)]
        if self._added is None:
            return found
        return [None if residual is None else residual + self._added[:count] for residual in found]

    def differentiate(self, here: Try) -> None:
        """Take the derivatives by the deviations there: forward differences, 0 where a rollout diverges."""
        moved = [replace(here, deviations=here.deviations + step) for step in np.eye(NUISANCES)[self.unsure]]
        flown = [here, *(one for one, k in zip(moved, self.unsure, strict=True) if k < MOTION)]
        paths = self._paths(flown, self.frames, self._body[0])
        # What only moves the rendered body needs no rollout.
        paths += [paths[0]] * (1 + len(moved) - len(flown))
        base, *there = (
            self._residual(one, path, self._body[1]) for one, path in zip([here, *moved], paths, strict=True)
        )
        if base is not None:  # it held for the frames that are fitted
            self.by_deviation = [torch.zeros_like(base) if each is None else each - base for each in there]

    def refine_particles(self, here: Try) -> None:
        """Add what more particles change in the images to all residuals from now on, and know how sure that is."""
        if not self._finer:
            return
        coarse, *fine = (
            self._residual(here, self._paths([here], self.frames, body)[0], renderer)
            for body, renderer in (self._body, *self._finer)
        )
        fine = [residual for residual in fine if residual is not None]
        if coarse is not None and fine:
            self._added = torch.stack(fine).mean(0) - coarse
            self.spread = fine[0] - fine[-1] if len(fine) > 1 else None

    def _paths(
        self, tries: Sequence[Try], frames: tuple[int, ...], body: Reconstruction
    ) -> list[Trajectory | None]:
        self.rollouts += len(tries)
        starts = [self.throw.moved(one.deviations[:MOTION]).of_body(body) for one in tries]
        laws = [analytic_law(one.law, self.model.dt).to(starts[0].x.device) for one in tries]
        options = dict(steps=frames[-1], frames=frames, total=self._total)
        return rollout_batch(self.model, laws, starts, **options)

    @torch.no_grad()
    def _residual(self, one: Try, path: Trajectory | None, renderer: ParticleGS) -> Tensor | None:
        if path is None:
            return None
        right, down, enlargement = (self._misplaced * one.deviations[MOTION:]).tolist()
        images = []
        for part in frame_batches(len(path.x), renderer.frames_per_batch):
            centre = path.x[part].mean(dim=1, keepdim=True)
            x = centre + (1 + enlargement) * (path.x[part] - centre)
            x = x + right * self._axes[0] + down * self._axes[1]
            images.append(averaged(renderer(x, (1 + enlargement) * path.stretch[part]), self.finest))
        residual = self.weight * (torch.cat(images) - self._observed[: len(path.x)])
        return residual if bool(residual.isfinite().all()) else None


def averaged(images: Tensor, size: int) -> Tensor:
    """Images (T, V, H, W, C) averaged over squares of ``size`` pixels, those at the far edges over what is there."""
    if size == 1:
        return images
    T, V = images.shape[:2]
    flat = images.flatten(0, 1).movedim(-1, 1)
    pooled = torch.nn.functional.avg_pool2d(flat, size, ceil_mode=True, count_include_pad=False)
    return pooled.movedim(1, -1).unflatten(0, (T, V))
