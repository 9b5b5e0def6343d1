"""Penalty in function space on the change of a law by its adaptor at deformations that the video does not contain.

The images constrain the stress only at the visited deformations. Elsewhere a trained law is determined by arbitrary
weights, which matters for other motions. States are therefore sampled around and beyond the visited ones, and the law
is held there to its prior, the law without the adaptor.

**States.** F = V diag(exp e) V^T, which suffices for a frame-indifferent law. The principal logarithmic strains e have
uniform directions, i.e. all mixtures of volume change and shear, and norms |e| uniform between 0 and `REACH` times the
99th percentile of the visited ones. V is a uniform rotation. States are sampled once from a fixed seed.

**Weights.** The weight of a state is 1 - exp(-(d / w)^2) with its distance d to the nearest visited state and w =
`BLUR` times the largest sampled norm. Distances are between principal strains for an isotropic part, and between
matrices log U, U the right stretch, for others, for which a stretch along another axis is a different state.

**Penalty.** For each trainable part, the mean over all states of the weighted squared change of its result y from y_0,

    |y - y_0|^2 / (|y_0|^2 + (`FLOOR` r)^2),   r the root mean square of |y_0|.

y is the Kirchhoff stress of the elasticity. For the plasticity y is the returned elastic deformation, and the strain
|F_trial - I| replaces |y_0| in the denominator. A penalty of 0.01 is a change of 10 % at every state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.mechanics.adaptor import AdaptableConstitutive, AdaptableLaw
from neuma_lib.sim.state import Trajectory

STATES = 1024
REACH = 2.0
BLUR = 0.05
FLOOR = 0.1
MIN_SIZE, MAX_SIZE = 1e-2, 1.0
"""Bounds of the largest sampled |e|, for bodies that hardly deform and against excessive compression."""
_MAX_VISITED = 20_000
"""Maximum number of visited states for distances."""
_SEED = 0


class Deviation:
    """Deviation of a law from its prior at states that a video does not visit.

    Args:
        law: the law, whose reference is its response without the adaptor.
        visited: deformation gradients (M, 3, 3) at which the video evaluates each part, by name of the part.
        states: number of sampled states per part.

    Attributes:
        states: sampled deformation gradients (S, 3, 3) of each part.
        weights: their weights (S,) in [0, 1].

    Raises:
        InputError: the law has no trainable part, or one has no visited states.
    """

    def __init__(self, law: AdaptableLaw, visited: Mapping[str, Tensor], states: int = STATES):
        parts = {name: part for name, part in law.parts.items() if part.adaptor is not None}
        if not parts or not parts.keys() <= visited.keys():
            raise InputError("penalty", f"law {law.name!r} needs an adaptor and visited states of its parts")
        self._parts = parts
        self.states, self.weights, self._references, self._scales = {}, {}, {}, {}
        for name, part in parts.items():
            F, self.weights[name] = sample_unvisited(visited[name], states, part.isotropic)
            self.states[name] = F
            with torch.no_grad():
                reference = part.response(F, tuple(part.base))
                scale = F - torch.eye(3).to(F) if name == "plasticity" else reference
                squares = scale.square().sum((1, 2))
                self._scales[name] = squares + FLOOR**2 * squares.mean()
            self._references[name] = reference

    @classmethod
    def of_videos(cls, law: AdaptableLaw, paths: Sequence[Trajectory], dt: float) -> Deviation:
        """For a law whose rollouts over the videos are ``paths``, with time step dt [s].

        The elasticity is evaluated at F, the plasticity at the trial deformation (I + dt C) F.
        """
        F, C = (torch.cat([getattr(path, name).detach().flatten(0, 1) for path in paths]) for name in "FC")
        trial = F + dt * (C @ F)
        return cls(law, {"elasticity": F, "plasticity": trial})

    def __call__(self) -> Tensor:
        """The penalty, which is 0 for the prior and differentiable in the parameters of the adaptor."""
        return torch.stack([self._of_part(name, part) for name, part in self._parts.items()]).sum()

    def _of_part(self, name: str, part: AdaptableConstitutive) -> Tensor:
        change = part.response(self.states[name], part.weights()) - self._references[name]
        return (self.weights[name] * change.square().sum((1, 2)) / self._scales[name]).mean()


def sample_unvisited(
    visited: Tensor, count: int, isotropic: bool, seed: int = _SEED
) -> tuple[Tensor, Tensor]:
    """Sample states around and beyond visited ones, with weights as described in the module.

    Args:
        visited: deformation gradients (M, 3, 3).
        count: number of states.
        isotropic: whether distances ignore the axes of stretches.
        seed: seed of the states.

    Returns:
        Symmetric deformation gradients (count, 3, 3) and weights in [0, 1], shape (count,), both like ``visited``.
    """
    from scipy.spatial import cKDTree  # here, because the import takes an eighth of a second

    generator = torch.Generator().manual_seed(seed)
    visited_e, visited_V = _log_stretches(visited[:: -(-len(visited) // _MAX_VISITED)])
    size = visited_e.norm(dim=1).quantile(0.99).clamp(max=MAX_SIZE / REACH)
    largest = max(REACH * float(size), MIN_SIZE)
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
    """Principal logarithmic strains (M, 3) and axes V (M, 3, 3) of the right stretches, float64 on the CPU."""
    squares, V = torch.linalg.eigh((F.mT @ F).double().cpu())
    return 0.5 * squares.clamp(min=1e-12).log(), V


def _coordinates(e: Tensor, V: Tensor, isotropic: bool) -> Tensor:
    """Coordinates whose Euclidean distance is that of the states: sorted e, or log U = V diag(e) V^T."""
    return e.sort(dim=1).values if isotropic else (V @ torch.diag_embed(e) @ V.mT).flatten(1)


def _rotations(count: int, generator: torch.Generator) -> Tensor:
    """Uniform rotations (count, 3, 3): the orthonormal factor of Gaussian matrices with unique signs."""
    Q, R = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    Q = Q * R.diagonal(dim1=1, dim2=2).sign()[:, None]
    return Q * Q.det().sign()[:, None, None]
