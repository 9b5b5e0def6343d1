"""Fused evaluation of analytic laws for several copies of a body, used by rollouts that differ in their constants.

`SideBySide` combines the elasticities (or plasticities) of several laws whose particles follow each other in memory.
Only values are computed here. Adjoints, and laws without a kernel, use the torch code of the laws, which is also the
reference in tests. A single law is faster too: torch needs ten launches and two singular value decompositions.

The weights of a copy are the index of its law and up to three coefficients in double precision, so that a recorded
CUDA graph applies to any constants.
"""

# No `from __future__ import annotations` here: Warp reads the annotations of kernels as objects.
from collections.abc import Callable, Hashable, Sequence
from functools import cache

import torch
import warp as wp
from torch import Tensor

from neuma_lib.device import launch, native_source, start_warp
from neuma_lib.mechanics import elasticity, plasticity
from neuma_lib.mechanics.catalogue import lame
from neuma_lib.mechanics.law import Constitutive, Elasticity, Law, Weights
from neuma_lib.mechanics.singular_values_kernels import LOAD, SVD, pack_count, snippet, warp_types

start_warp()

_TEXT = native_source(__file__, ".h")
_WIDTH = 4  # index of the law and coefficients
_BLOCK = 64  # threads per block on a GPU

Values = dict[str, float]


def _lame(values: Values) -> tuple[float, float]:
    return lame(values["E"], values["nu"])


def _twice_mu_and_lam(values: Values) -> tuple[float, ...]:
    mu, lam = _lame(values)
    return 2 * mu, lam


def _ogden(values: Values) -> tuple[float, ...]:
    mu, lam = _lame(values)
    return 2 * mu / values["alpha"], values["alpha"], lam + 2 * mu / 3


def _mooney_rivlin(values: Values) -> tuple[float, ...]:
    (mu, lam), q = _lame(values), values["q"]
    return mu * (1 - q), mu * q, lam + 2 * mu / 3


def _von_mises(values: Values) -> tuple[float, ...]:
    return values["yield_stress"] / (2 * _lame(values)[0]), 0.0


def _viscous_flow(values: Values) -> tuple[float, ...]:
    mu, _ = _lame(values)
    return values["yield_stress"] / (2 * mu), 1 / (1 + mu * values["dt"] / values["viscosity"])


_COEFFICIENTS: dict[type[Constitutive], Callable[[Values], tuple[float, ...]]] = {
    elasticity.FixedCorotated: _twice_mu_and_lam,
    elasticity.StVK: _twice_mu_and_lam,
    elasticity.Hencky: _twice_mu_and_lam,
    elasticity.NeoHookean: _lame,
    elasticity.Fluid: lambda values: _lame(values)[1:],
    elasticity.Ogden: _ogden,
    elasticity.MooneyRivlin: _mooney_rivlin,
    plasticity.Identity: lambda values: (),
    plasticity.VonMises: _von_mises,
    plasticity.DruckerPrager: lambda values: (plasticity.DruckerPrager.slope(**values), values["cohesion"]),
    plasticity.FluidProjection: lambda values: (),
    plasticity.ViscousFlow: _viscous_flow,
}
"""Coefficients of the kernels from the constants of a law."""

_INDEX = {part: index for index, part in enumerate(_COEFFICIENTS)}


class SideBySide(Constitutive):
    """Elasticities, or plasticities, of several laws that act on consecutive ranges of equally many particles.

    Args:
        parts: one per copy, with fixed constants and types that `fusible` accepts.
        device: device of the evaluation.
    """

    capturable = True

    def __init__(self, parts: Sequence[Constitutive], device: torch.device | str = "cpu"):
        super().__init__()
        self.parts = tuple(parts)
        self._kind = "elasticity" if isinstance(parts[0], Elasticity) else "plasticity"
        rows = torch.zeros(len(parts), _WIDTH, dtype=torch.float64)
        for row, part in zip(rows, parts, strict=True):
            coefficients = _COEFFICIENTS[type(part)](
                {key: float(value) for key, value in part.values.items()}
            )
            numbers = [_INDEX[type(part)], *coefficients]
            row[: len(numbers)] = torch.tensor(numbers, dtype=torch.float64)
        self._rows = rows.to(device)

    def graph_key(self) -> Hashable:
        return type(self), self._kind, len(self.parts)

    def weights(self) -> Weights:
        return (self._rows,)

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        return torch.cat(
            [part.response(own, ()) for part, own in zip(self.parts, F.chunk(len(self.parts)), strict=True)]
        )

    def evaluate(self, F: Tensor, weights: Weights, out: Tensor | None = None) -> Tensor:
        F = F.detach().contiguous()
        result = torch.empty_like(F) if out is None else out
        copies, N = len(self.parts), len(F) // len(self.parts)
        # `view` fails on a result that is not contiguous, instead of writing to a copy
        inputs = F.view(copies, N, 3, 3), weights[0], result.view(copies, N, 3, 3)
        kernel = _kernel(self._kind, F.dtype)
        launch(kernel, (copies, pack_count(N, F.device)), *inputs, N, block_dim=_BLOCK)
        return result


def fusible(law: Law) -> bool:
    """Whether both parts of a law have kernels."""
    return type(law.elasticity) in _COEFFICIENTS and type(law.plasticity) in _COEFFICIENTS


def side_by_side(laws: Sequence[Law], device: torch.device | str = "cpu") -> Law:
    """One law for consecutive copies, each of which follows its own law."""
    elastic = SideBySide([law.elasticity for law in laws], device)
    plastic = SideBySide([law.plasticity for law in laws], device)
    return Law(elastic, plastic, laws[0].name if len(laws) == 1 else f"{len(laws)} laws side by side")


@cache
def _kernel(kind: str, dtype: torch.dtype):
    """Kernel (F, rows, out, particles per copy), launched over copies and packs per copy."""
    real, _, mat33 = warp_types(dtype)
    names = f"enum {{ {', '.join(part.__name__ for part in _COEFFICIENTS)} }};\n"
    before = _TEXT["constants"] + (_TEXT["unchanged"] if kind == "plasticity" else "")
    text = snippet(names, before, LOAD, SVD, _TEXT["functions"], _TEXT[kind], dtype=dtype)

    @wp.func_native(text.replace("STRETCH_MIN", repr(elasticity.STRETCH_MIN)))
    def respond(
        F: wp.array(dtype=mat33), constants: wp.array(dtype=real), out: wp.array(dtype=mat33), block: int, n: int
    ): ...  # fmt: skip

    @wp.kernel(enable_backward=False, module="unique")
    def evaluate(
        F: wp.array2d(dtype=mat33), constants: wp.array2d(dtype=real), out: wp.array2d(dtype=mat33), n: int
    ):
        copy, block = wp.tid()
        respond(F[copy], constants[copy], out[copy], block, n)

    return evaluate
