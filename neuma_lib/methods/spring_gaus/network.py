"""Networks of springs between anchors in a body, and what decides their strength (Spring-Gaus, Zhong et al. 2024).

Anchors have unit mass, so that stiffnesses are forces per unit mass and strain [m/s^2].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor, nn
from torch.nn.functional import softplus

from neuma_lib.errors import InputError

FRICTION_START = -1.0
"""Published start of the parameter behind the part of its velocity that an anchor keeps on a wall: 0.22 of it."""


def farthest_points(x: Tensor, count: int) -> Tensor:
    """Indices, ascending, of points that lie far from each other: each next one is the farthest from all before.

    Args:
        x: positions [m], shape (N, 3).
        count: how many are wanted; all N if there are fewer.
    """
    points = x.detach().to("cpu", torch.float64).numpy()
    if count >= len(points):
        return torch.arange(len(points))
    chosen = [int(np.square(points - points.mean(0)).sum(1).argmax())]
    nearest = np.full(len(points), np.inf)
    while len(chosen) < count:
        nearest = np.minimum(nearest, np.square(points - points[chosen[-1]]).sum(1))
        chosen.append(int(nearest.argmax()))
    return torch.as_tensor(sorted(chosen))


@dataclass(frozen=True)
class SpringNetwork:
    """Springs from each anchor to its nearest ones, the nearest first.

    The lists are directed: anchor i pulls itself towards j with its own stiffness, j pulls back only if i is in its
    list, with its own. So neither momentum nor angular momentum is conserved exactly, as published.

    Attributes:
        anchors: positions at rest [m], shape (A, 3).
        neighbours: of each anchor, int32, shape (A, K).
        rest: lengths of the springs at rest [m], shape (A, K).
        hard: springs of each list, from the nearest on, that always pull fully.
        exponent: p of the law of the springs, see `kernels`.
    """

    anchors: Tensor
    neighbours: Tensor
    rest: Tensor
    hard: int
    exponent: float = 0.5

    @classmethod
    def of(cls, anchors: Tensor, neighbours: int, hard: int, exponent: float = 0.5) -> SpringNetwork:
        """Springs to the ``neighbours`` nearest anchors, or to all others where there are fewer.

        Raises:
            InputError: fewer than two anchors, or two in one place.
        """
        points = anchors.detach().to("cpu", torch.float64).numpy()
        if len(points) < 2:
            raise InputError(f"springs: {len(points)} anchors make no network; give more springs.anchors")
        count = min(neighbours, len(points) - 1)
        distance, index = cKDTree(points).query(points, k=count + 1)
        others = index != np.arange(len(points))[:, None]
        # An anchor may be pushed out of its own list by others in its place.
        others[others.all(1), -1] = False
        shape = (len(points), count)
        if not (distance[others] > 0).all():
            raise InputError("springs: two anchors are in one place; sample the particles again")
        rest, index = (
            torch.as_tensor(a[others].reshape(shape)).to(anchors.device) for a in (distance, index)
        )
        return cls(anchors, index.int(), rest.to(anchors), min(hard, count), exponent)

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> SpringNetwork:
        """The same in another precision or on another device."""
        anchors, rest = (value.to(device=device, dtype=dtype) for value in (self.anchors, self.rest))
        return SpringNetwork(anchors, self.neighbours.to(device), rest, self.hard, self.exponent)

    @property
    def reach(self) -> float:
        """Mean length of the hard springs [m]: the spacing of the anchors."""
        return float(self.rest[:, : self.hard or 1].mean())

    def soft_vector(self, kappa: Tensor) -> Tensor:
        """Parts eta of their stiffness that the springs of a list pull with, shape (K,), from the parameter kappa.

        1 for the hard ones; for the j-th of the m others, clamp(2 - (1 + e^kappa)^(j / m), 0, 1).
        """
        soft = self.rest.shape[1] - self.hard
        place = torch.arange(soft, dtype=kappa.dtype, device=kappa.device) / max(soft, 1)
        eta = (2 - torch.exp(softplus(kappa) * place)).clamp(0, 1)
        return torch.cat([eta.new_ones(self.hard), eta])

    def youngs_modulus(self, stiffness: Tensor, eta: Tensor, density: float) -> float:
        """Young's modulus [Pa] of a body of this mass density [kg/m^3] with these springs, at small strains.

        An isotropic network of central springs K has lambda = mu = sum K l^2 / (15 V), thus E = sum K l^2 / (6 V) with
        each pair counted once. Here K = (rho V / A) eta k / l, and every pair is in two lists.
        """
        return float((stiffness[:, None] * eta * self.rest).sum() * density / (12 * len(self.rest)))

    def stable_step(self, stiffness: Tensor, eta: Tensor, damping: Tensor) -> float:
        """A time step [s] below which small motions are stable, by Gershgorin's bound of the highest frequency.

        The rows of the stiffness and the damping matrix bound omega^2 and the highest rate of decay d; the
        semi-implicit step is stable for dt^2 omega^2 + 2 dt d < 4.
        """
        omega2 = 2 * float((stiffness[:, None] * eta / self.rest).sum(1).max())
        decay = 2 * float((damping / self.rest).sum(1).max())
        return float((np.sqrt(decay**2 + 4 * omega2) - decay) / omega2) if omega2 else 2 / max(decay, 1e-30)


class Springs(nn.Module):
    """What is learned of a network: a stiffness for each anchor, and four numbers that all share.

    Args:
        network: gives number of anchors, precision and device.
        stiffness: of every anchor at the start [m/s^2].
        damping: c [m/s].
        gap: how far inside the box anchors are stopped [m].
    """

    def __init__(self, network: SpringNetwork, stiffness: float, damping: float, gap: float = 0.0):
        super().__init__()
        like = network.rest
        self.network = network
        self.log_stiffness = nn.Parameter(like.new_full((len(like),), float(np.log10(stiffness))))
        self.softness = nn.Parameter(like.new_zeros(1))
        self.log_damping = nn.Parameter(like.new_full((1,), float(np.log10(damping))))
        self.grip = nn.Parameter(like.new_full((1,), FRICTION_START))
        self.gap = nn.Parameter(like.new_full((1,), gap))

    @classmethod
    def of_modulus(
        cls, network: SpringNetwork, E: float, density: float, damping: float, gap: float = 0.0
    ) -> Springs:
        """Springs of one stiffness, that of a body of Young's modulus E [Pa] and a mass density [kg/m^3]."""
        springs = cls(network, 1.0, damping, gap)
        with torch.no_grad():
            unit, eta, *_ = springs.values()
            springs.log_stiffness.fill_(float(np.log10(E / network.youngs_modulus(unit, eta, density))))
        return springs

    def for_network(self, network: SpringNetwork, density: float, other_density: float) -> Springs:
        """Springs of another body of the same material: the shared numbers, and one stiffness of the same modulus.

        Args:
            network: of the other body.
            density, other_density: mass densities of this body and of the other one [kg/m^3].
        """
        other = Springs(network, 1.0, 1.0)
        with torch.no_grad():
            for name in ("softness", "log_damping", "grip", "gap"):
                getattr(other, name).copy_(getattr(self, name))
            stiffness = self.modulus(density) / other.modulus(other_density)
            other.log_stiffness.fill_(float(np.log10(stiffness)))
        return other

    def values(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """What a rollout needs, differentiable.

        Returns:
            stiffnesses (A,) [m/s^2], soft vector (K,), damping (1,) [m/s]; friction (1,), the part of its velocity
            along a wall that an anchor keeps in a substep on it; gap (1,) [m].
        """
        friction = (1.2 * self.grip.sigmoid() - 0.1).clamp(0, 1)
        eta = self.network.soft_vector(self.softness)
        return 10**self.log_stiffness, eta, 10**self.log_damping, friction, self.gap

    @torch.no_grad()
    def shared(self) -> tuple[float, float, float]:
        """Damping [m/s], friction and gap [m] as numbers."""
        return tuple(float(value) for value in self.values()[2:])

    def modulus(self, density: float) -> float:
        """Young's modulus of the network [Pa], see `SpringNetwork.youngs_modulus`."""
        with torch.no_grad():
            stiffness, eta, *_ = self.values()
            return self.network.youngs_modulus(stiffness, eta, density)
