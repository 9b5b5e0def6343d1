"""Closed-form steps before the first contact, for an undeformed body with uniform velocity."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from neuma_lib.sim.model import MPM, MaterialRegion, contact_clearance, law_weights
from neuma_lib.sim.state import State, Trajectory

_MARGIN = 1e-3  # distance from the contact zone at which free flight ends [dx]


def free_flight_steps(
    model: MPM, regions: Sequence[MaterialRegion], state: State, last: int, copies: int = 1
) -> int:
    """Number of leading steps, at most `last`, in which only gravity acts and no particle deforms.

    Copies (see `kernels`) may have different velocities. The first contact of any copy ends free flight for all.
    """
    x, v, F, C = state.x, state.v, state.F, state.C
    if model.clamps:
        return 0
    if torch.is_grad_enabled() and (v.ndim == 2 and v.requires_grad or F.requires_grad or C.requires_grad):
        return 0
    with torch.no_grad():
        v = v.expand_as(x).unflatten(0, (copies, -1))
        if not (v == v[:, :1]).all():
            return 0
        if not (F == torch.eye(3, dtype=F.dtype, device=F.device)).all() or C.any() or state.stuck.any():
            return 0
        clear = _clear_steps(model, x.unflatten(0, (copies, -1)), v[:, :1], state.vol0.max(), last)
        if clear and not all(_at_rest(model, region, state, len(x) // copies) for region in regions):
            return 0
    return clear


def _clear_steps(model: MPM, x0: Tensor, v0: Tensor, vol0: Tensor, last: int) -> int:
    """Number of leading ballistic steps in which no particle of x0 (copies, N, 3) is in contact.

    Args:
        v0: velocities of the copies [m/s], shape (copies, 1, 3).
        vol0: largest volume of a particle [m^3].
    """
    x0, v0, vol0 = x0.double().cpu(), v0.double().cpu(), vol0.double().cpu().reshape(1)
    gravity = torch.tensor(model.gravity, dtype=torch.float64)

    def flown(x: Tensor, n: Tensor | int) -> Tensor:
        return x + n * model.dt * v0 + model.dt**2 * n * (n + 1) / 2 * gravity

    box = torch.stack([x0.amin(dim=1), x0.amax(dim=1)], dim=1)
    steps = torch.arange(last, dtype=torch.float64)[:, None, None, None]
    walls = replace(model, colliders=())
    touching = (contact_clearance(walls, flown(box, steps), vol0) <= _MARGIN * model.dx).any(dim=1)
    clear = int(touching.int().argmax()) if touching.any() else last
    n = 0
    while (
        model.colliders and n < clear
    ):  # as many steps at once as no particle can need to the nearest collider
        distance = float(contact_clearance(model, flown(x0, n), vol0, (n,)).min()) - _MARGIN * model.dx
        if distance <= 0:
            return n
        fastest = float(v0.norm(dim=-1).max() + clear * model.dt * gravity.norm()) + max(
            collider.fastest(clear * model.dt) for collider in model.colliders
        )
        n += max(1, int(distance / (fastest * model.dt))) if fastest else clear
    return clear


def _at_rest(model: MPM, region: MaterialRegion, state: State, copy: int) -> bool:
    """Whether the law preserves F = I, with a stress that has no effect in a step beyond round-off.

    The law of a region that spans several copies, of ``copy`` particles each, may differ from copy to copy.
    """
    x0, firsts = state.x, slice(region.start, region.stop, copy)
    mass, vol0 = state.mass[firsts], state.vol0[firsts]
    eye = torch.eye(3, dtype=x0.dtype, device=x0.device).repeat(len(mass), 1, 1)
    elastic, plastic = law_weights(region.law, x0.dtype)
    tau = region.law.elasticity.evaluate(eye, elastic)
    F = region.law.plasticity.evaluate(eye, plastic)
    eps = torch.finfo(x0.dtype).eps
    kick = float((tau.abs().amax(dim=(1, 2)) * vol0 / mass).max()) * model.dt / model.dx
    return kick <= eps and float((F - eye).abs().max()) <= 4 * eps


def ballistic(
    model: MPM, start: tuple[Tensor, ...], more: Sequence[str], tracers: Tensor | None, frames: Sequence[int]
) -> Trajectory:
    """Free flight: x_n = x0 + n dt v0 + g dt^2 n (n + 1) / 2, v_n = v0 + n dt g.

    ``start`` is (x, v, F, C) and the parts named in ``more``, which do not change.
    """
    x0, v0, *constant = start
    T = len(frames)
    n = torch.tensor(frames, dtype=torch.float64)[:, None, None]
    gravity = torch.tensor(model.gravity, dtype=torch.float64)
    fall, gain = (
        t.to(dtype=x0.dtype, device=x0.device)
        for t in (model.dt**2 * n * (n + 1) / 2 * gravity, model.dt * n * gravity)
    )
    elapsed = (model.dt * n).to(dtype=x0.dtype, device=x0.device)
    F, C, *rest = (value.expand(T, *value.shape) for value in constant)
    return Trajectory(
        tuple(frames),
        x0 + (elapsed * v0 + fall),
        v0 + gain,
        F,
        C,
        None if tracers is None else tracers + (elapsed * v0[0] + fall).detach(),
        **dict(zip(more, rest, strict=True)),
    )
