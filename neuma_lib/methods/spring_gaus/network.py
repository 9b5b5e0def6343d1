"""Networks of springs between anchors in a body, and their trainable parameters (Spring-Gaus, Zhong et al. 2024).

Anchors have unit mass, so stiffnesses are forces per unit mass and strain [m/s^2].
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
"""Published initial friction parameter, for which an anchor on a wall keeps 0.22 of its velocity per substep."""


def farthest_points(x: Tensor, count: int) -> Tensor:
    """Ascending indices of ``count`` points, at most N, of x (N, 3) [m], by farthest-point sampling."""
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
    """Springs from each anchor to its nearest neighbours in order of distance.

    Springs are directed: the force on i from j has the stiffness of i, and j is pulled by i only if i is in its list.
    Momentum and angular momentum are therefore not exactly conserved, as published.
    """

    anchors: Tensor  # positions at rest [m], shape (A, 3)
    neighbours: Tensor  # indices of the neighbours, int32, shape (A, K)
    rest: Tensor  # rest lengths [m], shape (A, K)
    hard: int  # number of nearest springs per anchor whose eta is always 1
    exponent: float = 0.5  # p of the force, see `kernels`

    @classmethod
    def of(cls, anchors: Tensor, neighbours: int, hard: int, exponent: float = 0.5) -> SpringNetwork:
        """Springs to the ``neighbours`` nearest anchors, or to all others if there are fewer.

        Raises:
            InputError: fewer than two anchors, or two at the same position.
        """
        points = anchors.detach().to("cpu", torch.float64).numpy()
        if len(points) < 2:
            raise InputError("springs.anchors", f"{len(points)} must be at least 2")
        count = min(neighbours, len(points) - 1)
        distance, index = cKDTree(points).query(points, k=count + 1)
        others = index != np.arange(len(points))[:, None]
        # An anchor may be missing in its own list if others have the same position.
        others[others.all(1), -1] = False
        shape = (len(points), count)
        if not (distance[others] > 0).all():
            problem = "two anchors have the same position"
            raise InputError("springs.anchors", problem, "Sample the particles again")
        rest, index = (
            torch.as_tensor(a[others].reshape(shape)).to(anchors.device) for a in (distance, index)
        )
        return cls(anchors, index.int(), rest.to(anchors), min(hard, count), exponent)

    def to(self, dtype: torch.dtype, device: torch.device | str | None = None) -> SpringNetwork:
        """Copy to another precision or device."""
        anchors, rest = (value.to(device=device, dtype=dtype) for value in (self.anchors, self.rest))
        return SpringNetwork(anchors, self.neighbours.to(device), rest, self.hard, self.exponent)

    @property
    def reach(self) -> float:
        """Mean length of the hard springs, the spacing of the anchors [m]."""
        return float(self.rest[:, : self.hard or 1].mean())

    def soft_vector(self, kappa: Tensor) -> Tensor:
        """Factors eta of the stiffness by position in a list, shape (K,), from the parameter kappa.

        1 for hard springs, clamp(2 - (1 + e^kappa)^(j / m), 0, 1) for the j-th of the m others.
        """
        soft = self.rest.shape[1] - self.hard
        place = torch.arange(soft, dtype=kappa.dtype, device=kappa.device) / max(soft, 1)
        eta = (2 - torch.exp(softplus(kappa) * place)).clamp(0, 1)
        return torch.cat([eta.new_ones(self.hard), eta])

    def youngs_modulus(self, stiffness: Tensor, eta: Tensor, density: float) -> float:
        """Young's modulus [Pa] at small strains for a mass density [kg/m^3].

        An isotropic network of central springs K has lambda = mu = sum K l^2 / (15 V), thus E = sum K l^2 / (6 V) with
        each pair counted once. Here K = (rho V / A) eta k / l, and every pair is in two lists.
        """
        return float((stiffness[:, None] * eta * self.rest).sum() * density / (12 * len(self.rest)))

    def stable_step(self, stiffness: Tensor, eta: Tensor, damping: Tensor) -> float:
        """A time step [s] below which small motions are stable, by Gershgorin's bound of the highest frequency.

        The rows of the stiffness and damping matrices bound omega^2 and the highest decay rate d. The semi-implicit
        step is stable for dt^2 omega^2 + 2 dt d < 4.
        """
        omega2 = 2 * float((stiffness[:, None] * eta / self.rest).sum(1).max())
        decay = 2 * float((damping / self.rest).sum(1).max())
        return float((np.sqrt(decay**2 + 4 * omega2) - decay) / omega2) if omega2 else 2 / max(decay, 1e-30)


class Springs(nn.Module):
    """Trainable parameters of a network: a stiffness per anchor, and four shared numbers.

    Args:
        network: the network.
        stiffness: initial stiffness of every anchor [m/s^2].
        damping: c [m/s].
        gap: distance from the box at which anchors are in contact [m].
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
        """Springs with a uniform stiffness that gives a Young's modulus E [Pa] for a mass density [kg/m^3]."""
        springs = cls(network, 1.0, damping, gap)
        with torch.no_grad():
            unit, eta, *_ = springs.values()
            springs.log_stiffness.fill_(float(np.log10(E / network.youngs_modulus(unit, eta, density))))
        return springs

    def for_network(self, network: SpringNetwork, density: float, other_density: float) -> Springs:
        """Springs of another body of the same material, with the shared numbers and a uniform stiffness of the same
        modulus.

        Args:
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
        """Differentiable parameters of a rollout.

        Returns:
            Stiffnesses (A,) [m/s^2], soft vector (K,), damping (1,) [m/s], friction (1,), which is the factor of the
            tangential velocity per substep in contact, and gap (1,) [m].
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
