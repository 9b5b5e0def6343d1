"""A body whose particles follow the anchors of a network of springs."""

from dataclasses import dataclass

import torch
from torch import Tensor

from neuma_lib.coupling.interpolation import Interpolation
from neuma_lib.errors import InputError
from neuma_lib.methods.spring_gaus.network import SpringNetwork, farthest_points
from neuma_lib.sim.state import State, Trajectory


@dataclass(frozen=True)
class SpringBody:
    """A body with particles of which some are anchors."""

    index: Tensor  # particles that are anchors, int64, shape (A,)
    network: SpringNetwork  # springs between the anchors
    follow: Interpolation  # interpolation from the anchors to all N particles

    @classmethod
    def of(
        cls, x0: Tensor, anchors: int, neighbours: int, hard: int, exponent: float, carriers: int
    ) -> "SpringBody":
        """Choose anchors by farthest-point sampling of the particles x0 (N, 3) [m], and connect them by springs."""
        index = farthest_points(x0, anchors).to(x0.device)
        network = SpringNetwork.of(x0[index], neighbours, hard, exponent)
        return cls(index, network, Interpolation(x0, network.anchors, carriers))

    @classmethod
    def with_network(cls, x0: Tensor, index: Tensor, network: SpringNetwork, carriers: int) -> "SpringBody":
        """The body of an existing network. Raises InputError if its anchors are not the particles ``index``."""
        if index.max() >= len(x0) or not torch.equal(x0[index], network.anchors):
            problem = "the anchors are not particles of the body"
            raise InputError("springs", problem, "Run the rule fit_spring_gaus again")
        return cls(index, network, Interpolation(x0, network.anchors, carriers))

    def start(self, state: State) -> tuple[Tensor, Tensor]:
        """Positions [m] and velocities [m/s] of the anchors, shape (A, 3), in a state of the particles."""
        x, v, *_ = state.motion
        return x[self.index], v[self.index]

    def path(
        self, frames: tuple[int, ...], x: Tensor, v: Tensor, tracers: Tensor | None = None
    ) -> Trajectory:
        """States of the particles from those of the anchors at frames, x and v (T, A, 3).

        F is the gradient of the interpolated motion, without a plastic part. C is zero.
        """
        positions, F = self.follow(x)
        return Trajectory(frames, positions, self.follow.velocities(v), F, torch.zeros_like(F), tracers)
