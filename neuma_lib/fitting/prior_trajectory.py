"""Priors by trajectory, NCLaw's training (Ma et al. 2023): only the positions of one thrown cube are seen.

The gradient goes through the simulator; a prior takes many minutes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import nn

from neuma_lib.config.priors import TrajectoryConfig
from neuma_lib.fitting.prior_throws import DENSITY, Progress, Throw
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.neural import NeuralLaw, neural_law
from neuma_lib.sim.model import MPMModel
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State


def train_by_trajectory(
    spec: Mapping[str, Any], settings: TrajectoryConfig, seed: int, progress: Progress
) -> tuple[NeuralLaw, dict[str, Any]]:
    throw = _nclaw_throw(settings)
    truth = throw.run(analytic_law(spec, dt=settings.dt), list(range(settings.steps + 1)))
    law = neural_law(seed=seed)
    groups = {
        "elasticity": (list(law.elasticity.base), settings.learning_rate_elastic),
        "plasticity": (list(law.plasticity.base), settings.learning_rate_plastic),
    }
    for parameters, _ in groups.values():
        for parameter in parameters:
            parameter.requires_grad_()
    optimiser = torch.optim.Adam([{"params": p, "lr": rate} for p, rate in groups.values()])
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, settings.epochs)
    history = []
    for epoch in range(settings.epochs):
        share = epoch / max(settings.epochs - 1, 1)
        length = round(settings.reset_first + share * (settings.reset_last - settings.reset_first))
        optimiser.zero_grad(set_to_none=True)
        total = 0.0
        for first in range(0, settings.steps, length):
            count = min(length, settings.steps - first)
            start = {name: getattr(truth, name)[first] for name in ("x", "v", "F", "C")}
            path = rollout(
                throw.model,
                law,
                replace(throw.state, **start),
                steps=count,
                frames=range(1, count + 1),
                skip_free_flight=False,
            )
            loss = (path.x - truth.x[first + 1 : first + count + 1]).square().mean(dim=(1, 2)).sum()
            loss.backward()
            total += float(loss.detach())
        for parameters, _ in groups.values():
            nn.utils.clip_grad_norm_(parameters, settings.gradient_clip)
        optimiser.step()
        schedule.step()
        history.append(total / settings.steps)
        progress(epoch + 1, settings.epochs, history[-1])
    for parameters, _ in groups.values():
        for parameter in parameters:
            parameter.requires_grad_(False)
    return law, {"loss": history}


def _nclaw_throw(settings: TrajectoryConfig) -> Throw:
    """NCLaw's training throw: a cube of side 0.5 m in the middle of a slippery box."""
    side, n = 0.5, settings.side_particles
    ticks = side * ((torch.arange(n) + 0.5) / n - 0.5)
    local = torch.cartesian_prod(ticks, ticks, ticks)
    omega = torch.full((3,), 4.0)
    v = torch.tensor([1.0, -1.5, -2.0]) + torch.linalg.cross(omega.expand_as(local), local)
    model = MPMModel(settings.grid, settings.dt, boundary="slip", walls="released", wall_cells=3)
    mass = torch.full((len(local),), DENSITY * side**3 / len(local))
    return Throw(model, State(0.5 + local, v, mass, mass / DENSITY), settings.steps)
