"""A penalty on what a correction does to a law where the video is silent, in function space instead of on weights.

The images say what stress the visited deformations have. What a trained law answers elsewhere is up to the weights that
happened to explain the images, and shows when it is thrown in another shape. So states are sampled around and beyond
the visited ones, and the law is held there to its prior, what it is without the adaptor.

**States.** F = V diag(exp e) V^T, since a law that is frame-indifferent needs no further rotation. The principal
logarithmic strains e have uniform directions in their space, so all mixtures of volume change and shear, and sizes |e|
uniform between 0 and `REACH` times the 99th percentile of the visited ones; V is uniform among rotations. Sampled once
from a fixed seed, they stay what they are for the whole training.

**Weights.** A state counts 1 - exp(-(d / w)^2), d its distance to the nearest visited state and w a `BLUR` of the
largest sampled size: nothing where the video speaks, 1 away from it. Distances are between principal strains for a part
that is isotropic, between the matrices log U, U the right stretch, for one that is not: there, a stretch along another
axis is another state.

**Penalty.** For each trainable part, the mean over all states of the weighted squared change of its answer y from y_0,
relative to the size of what it answers:

    |y - y_0|^2 / (|y_0|^2 + (`FLOOR` r)^2),   r the root mean square of |y_0|,

with the Kirchhoff stress as y of the elasticity. For the plasticity, y is the elastic deformation that it returns, and
its size is the strain |F_trial - I| that it is asked about. So a penalty of 0.01 is a change of 10 % at every state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.mechanics.adaptor import AdaptableConstitutive, AdaptableLaw
from neuma_lib.sim.state import Trajectory

STATES = 1024
REACH = 2.0
BLUR = 0.05
FLOOR = 0.1
LEAST_SIZE, LARGEST_SIZE = 1e-2, 1.0
"""Bounds of the largest sampled |e|: a body that hardly deforms still has states, and none is squeezed beyond use."""
_MOST_VISITED = 20_000
"""Visited states that distances are measured to."""
_SEED = 0


class Deviation:
    """How far a law is from what it was, on states that a video did not visit.

    Args:
        law: what it answers without its adaptor is the reference.
        visited: deformation gradients (M, 3, 3) that each part is asked about in the video, by the part's name.
        states: number of sampled states a part.

    Attributes:
        states: sampled deformation gradients (S, 3, 3) of each part.
        weights: their weights (S,) in [0, 1].

    Raises:
        InputError: the law has no trainable part, or one has no visited states.
    """

    def __init__(self, law: AdaptableLaw, visited: Mapping[str, Tensor], states: int = STATES):
        parts = {name: part for name, part in law.parts.items() if part.adaptor is not None}
        if not parts or not parts.keys() <= visited.keys():
            raise InputError(
                "a penalty on unvisited states needs a law with an adaptor, and what it has visited"
            )
        self._parts = parts
        self.states, self.weights, self._answers, self._sizes = {}, {}, {}, {}
        for name, part in parts.items():
            F, self.weights[name] = sample_unvisited(visited[name], states, part.isotropic)
            self.states[name] = F
            with torch.no_grad():
                answer = part.response(F, tuple(part.base))
                asked = F - torch.eye(3).to(F) if name == "plasticity" else answer
                squares = asked.square().sum((1, 2))
                self._sizes[name] = squares + FLOOR**2 * squares.mean()
            self._answers[name] = answer

    @classmethod
    def of_videos(cls, law: AdaptableLaw, paths: Sequence[Trajectory], dt: float) -> Deviation:
        """For a law whose rollouts over the videos are ``paths``, with time step dt [s].

        The elasticity is asked about F, the plasticity about what F becomes in a step, (I + dt C) F.
        """
        F, C = (torch.cat([getattr(path, name).detach().flatten(0, 1) for path in paths]) for name in "FC")
        trial = F + dt * (C @ F)
        return cls(law, {"elasticity": F, "plasticity": trial})

    def __call__(self) -> Tensor:
        """The penalty, a number that is 0 for the prior and differentiable in the adaptor's parameters."""
        return torch.stack([self._of_part(name, part) for name, part in self._parts.items()]).sum()

    def _of_part(self, name: str, part: AdaptableConstitutive) -> Tensor:
        change = part.response(self.states[name], part.weights()) - self._answers[name]
        return (self.weights[name] * change.square().sum((1, 2)) / self._sizes[name]).mean()


def sample_unvisited(
    visited: Tensor, count: int, isotropic: bool, seed: int = _SEED
) -> tuple[Tensor, Tensor]:
    """States around and beyond visited ones, and how little the video says of each; see the module.

    Args:
        visited: deformation gradients (M, 3, 3).
        count: number of states.
        isotropic: whether stretches are told apart by their sizes alone, not by their axes.
        seed: of the states.

    Returns:
        Symmetric deformation gradients (count, 3, 3) and weights in [0, 1], shape (count,), both like ``visited``.
    """
    generator = torch.Generator().manual_seed(seed)
    visited_e, visited_V = _log_stretches(visited[:: -(-len(visited) // _MOST_VISITED)])
    size = visited_e.norm(dim=1).quantile(0.99).clamp(max=LARGEST_SIZE / REACH)
    largest = max(REACH * float(size), LEAST_SIZE)
    direction = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    radius = largest * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    e = radius * direction / direction.norm(dim=1, keepdim=True)
    V = _rotations(count, generator)
    F = V @ torch.diag_embed(e.exp()) @ V.mT
    near = _coordinates(visited_e, visited_V, isotropic)
    distance, _ = cKDTree(near.numpy()).query(_coordinates(e, V, isotropic).numpy())
    weights = -torch.expm1(-((torch.from_numpy(distance) / (BLUR * largest)) ** 2))
    return F.to(visited), weights.to(visited)


def _log_stretches(F: Tensor) -> tuple[Tensor, Tensor]:
    """Principal logarithmic strains (M, 3) and the axes V (M, 3, 3) of right stretches, float64 on the CPU."""
    squares, V = torch.linalg.eigh((F.mT @ F).double().cpu())
    return 0.5 * squares.clamp(min=1e-12).log(), V


def _coordinates(e: Tensor, V: Tensor, isotropic: bool) -> Tensor:
    """Points between which the Euclidean distance is that of the states: sorted e, or log U = V diag(e) V^T."""
    return e.sort(dim=1).values if isotropic else (V @ torch.diag_embed(e) @ V.mT).flatten(1)


def _rotations(count: int, generator: torch.Generator) -> Tensor:
    """Uniform rotations (count, 3, 3): the orthonormal factor of Gaussian matrices, with the signs made unique."""
    Q, R = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    Q = Q * R.diagonal(dim1=1, dim2=2).sign()[:, None]
    return Q * Q.det().sign()[:, None, None]
