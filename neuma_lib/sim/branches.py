"""Viscous branches of laws as additional particles.

The particles of a branch have the places, velocities, volumes and clamps of the particles of the law, and share their
mass by halves. Both add stress and momentum to the same nodes and move with them, so that their positions and affine
velocities stay equal, while the deformation gradient of the branch relaxes. Kernels, adjoints and memory plans are
those of any particles.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from neuma_lib.sim.model import MaterialRegion
from neuma_lib.sim.state import State, Trajectory


def branched(
    regions: Sequence[MaterialRegion], state: State
) -> tuple[tuple[MaterialRegion, ...], State, Tensor] | None:
    """Regions and state with the particles of all branches after the others, or None if no law has a viscous part.

    Also the indices (B,) of the particles of the laws of the B particles of branches.
    """
    viscous = [region for region in regions if region.law.viscosity is not None]
    if not viscous:
        return None
    extended, stop = list(regions), len(state.x)
    for region in viscous:
        start, stop = stop, stop + region.stop - region.start
        extended.append(MaterialRegion(region.law.viscosity.branch, start, stop))
    device = state.x.device
    owners = torch.cat([torch.arange(each.start, each.stop, device=device) for each in viscous])

    def with_branches(value: Tensor) -> Tensor:
        return torch.cat([value, value[owners]])

    eye = torch.eye(3, dtype=state.x.dtype, device=device)
    F_branch = eye.expand_as(state.F) if state.F_branch is None else state.F_branch
    mass = state.mass.index_copy(0, owners, state.mass[owners] / 2)
    both = State(
        with_branches(state.x),
        state.v if state.v.ndim == 1 else with_branches(state.v),
        with_branches(mass),
        with_branches(state.vol0),
        torch.cat([state.F, F_branch[owners]]),
        with_branches(state.C),
        None if state.clamp is None else with_branches(state.clamp),
        with_branches(state.stuck),
        stiffness=None if state.stiffness is None else with_branches(state.stiffness),
    )
    return tuple(extended), both, owners


def merged(path: Trajectory, owners: Tensor, count: int) -> Trajectory:
    """The trajectory of the ``count`` particles of the laws, with F_branch of those with a branch and I of others."""
    branch = path.F[:, count:]
    if len(owners) < count:
        eye = torch.eye(3, dtype=branch.dtype, device=branch.device).expand(len(branch), count, 3, 3)
        branch = eye.index_copy(1, owners, branch)
    own = path.of(slice(count))
    return replace(own, F_branch=branch)
