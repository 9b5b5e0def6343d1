"""Several analytic laws as one, for rollouts of copies of a body that differ in their constants.

The particles of the copies follow each other in memory. All are evaluated in one launch (`analytic_kernels`).
"""

from collections.abc import Hashable, Sequence

import torch
from torch import Tensor

from neuma_lib.mechanics import analytic_kernels as kernels
from neuma_lib.mechanics.isotropic import Constants
from neuma_lib.mechanics.law import Constitutive, Law, Weights


class SideBySide(Constitutive):
    """Elasticities, or plasticities, of several laws that act on consecutive ranges of equally many particles.

    Its weights are the rows of the kernels, so that a recorded CUDA graph applies to any constants.

    Args:
        parts: one per copy, with kernels and fixed constants.
        device: device of the evaluation.
    """

    capturable = True
    native = True
    loops = True
    native_rows = True

    def __init__(self, parts: Sequence[Constants], device: torch.device | str = "cpu"):
        super().__init__()
        self.parts = tuple(parts)
        self.part = parts[0].part
        self._rows = torch.stack([part.row() for part in parts]).to(device)

    def graph_key(self) -> Hashable:
        return type(self), self.part, len(self.parts)

    def weights(self) -> Weights:
        return (self._rows,)

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        return torch.cat(
            [part.response(own, ()) for part, own in zip(self.parts, F.chunk(len(self.parts)), strict=True)]
        )

    @property
    def identity(self) -> bool:
        return all(part.identity for part in self.parts)

    @property
    def keeps_singular_values(self) -> bool:
        return any(part.keeps_singular_values for part in self.parts)

    def kernel_rows(self, F: Tensor, weights: Weights) -> Tensor:
        return weights[0]

    def kernel(self, F, weights, backward):
        return kernels.kernel_of(self.part, F, weights[0], backward)

    def cache_shape(self, F, weights):
        return kernels.cache_shape(len(weights[0]), len(F), F)

    def evaluate(self, F: Tensor, weights: Weights, out: Tensor | None = None) -> Tensor:
        return kernels.evaluate(self.part, F, weights[0], out)

    def evaluate_with_cache(self, F, weights, out=None, cache=None):
        if not self.keeps_singular_values:
            return self.evaluate(F, weights, out), None
        cache = kernels.new_cache(F, len(self.parts)) if cache is None else cache
        return kernels.evaluate(self.part, F, weights[0], out, cache), cache

    def vjp(self, F, weights, grad_out, cache=None, grad_F=None, grad_weights=None):
        grad_weights = (torch.zeros_like(weights[0]),) if grad_weights is None else grad_weights
        return kernels.vjp(self.part, F, weights[0], grad_out, cache, grad_F, grad_weights[0]), grad_weights


def has_kernels(law: Law) -> bool:
    """Whether all parts of a law have kernels and fixed constants."""
    parts = law.elasticity, law.plasticity
    fixed = law.viscosity is None or not law.viscosity.weights()
    return fixed and all(isinstance(part, Constants) and part.native and not part.weights() for part in parts)


def fusible(law: Law) -> bool:
    """Whether a law can be one of those of `side_by_side`: with kernels, and without a viscous part."""
    return law.viscosity is None and has_kernels(law)


def side_by_side(laws: Sequence[Law], device: torch.device | str = "cpu") -> Law:
    """One law for consecutive copies, each of which follows its own law."""
    elastic = SideBySide([law.elasticity for law in laws], device)
    plastic = SideBySide([law.plasticity for law in laws], device)
    return Law(elastic, plastic, laws[0].name if len(laws) == 1 else f"{len(laws)} laws side by side")
