"""State at rest under gravity, as the start of a motion."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from neuma_lib.errors import InputError
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.clamps import clamped_particles
from neuma_lib.sim.model import MPM, MaterialRegion, as_regions, with_fields
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State


@torch.no_grad()
def settle(
    model: MPM,
    law: Law | Sequence[MaterialRegion],
    state: State,
    *,
    tolerance: float = 1e-3,
    stages: int = 4,
    every: int = 20,
    quiet: int = 400,
    max_steps: int = 50_000,
) -> State:
    """The state of rest under gravity, with colliders and clamps in their poses at t = 0.

    Gravity increases in equal stages. Velocities are set to zero whenever the kinetic energy has passed a maximum,
    where the dominant vibration passes its equilibrium (kinetic damping, Cundall 1976). A stage ends at the first
    maximum, the last one when all speeds have stayed below the tolerance for a time without damping.

    The viscous part of a law is relaxed at rest. It has no effect here.

    Args:
        model, law, state: as in `simulate`. Velocities of the state are not used.
        tolerance: largest speed [m/s].
        stages: increments of gravity. More of them follow the loading path of a plastic law more closely.
        every: time steps between two values of the energy, fewer than a quarter of the slowest period.
        quiet: time steps without damping at the end, at least a quarter of the slowest period.
        max_steps: limit of the number of steps.

    Returns:
        The state at rest. It keeps the assignment of particles to clamps.

    Raises:
        InputError: the body does not come to rest, or as `simulate`.
        NonFiniteError: as `simulate`.
    """
    clamps = tuple(replace(clamp.at_rest(), release=float("inf")) for clamp in model.clamps)
    still = replace(model, colliders=tuple(each.at_rest() for each in model.colliders), clamps=clamps)
    state = with_fields(state, as_regions(law, len(state.x)))
    regions = [
        replace(each, law=Law(each.law.elasticity, each.law.plasticity, each.law.name))
        for each in as_regions(law, len(state.x))
    ]
    clamp = clamped_particles(clamps, state.x) if clamps and state.clamp is None else state.clamp
    rest = {"v": torch.zeros_like(state.x), "C": torch.zeros_like(state.F)}
    state, taken = replace(state, clamp=clamp, F_branch=None, **rest), 0
    for stage in range(1, stages + 1):
        gravity = tuple(stage / stages * g for g in model.gravity)
        ramped, energy, calm = replace(still, gravity=gravity), 0.0, 0
        while calm < quiet:
            path = rollout(ramped, regions, state, steps=every, frames=(every,), skip_free_flight=False)
            state = state.after(path)
            taken, before = taken + every, energy
            energy = float(state.mass @ state.v.square().sum(dim=1))
            speed = float(state.v.norm(dim=1).max())
            calm = calm + every if stage == stages and speed < tolerance else 0
            if not calm and taken >= max_steps:
                raise InputError(
                    "settle",
                    f"the body moves at {speed:.3g} m/s > {tolerance:g} m/s after {taken} steps",
                    "Hold it by clamps or colliders, or raise tolerance or max_steps",
                )
            if not calm and energy <= before:
                state, energy = replace(state, **rest), 0.0
                if stage < stages:
                    break
    return replace(state, **rest)
