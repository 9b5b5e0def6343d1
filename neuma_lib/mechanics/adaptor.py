"""Low-rank adaptor (the paper's Delta M, Sec. 3.2): the trained correction of a frozen prior."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from neuma_lib.errors import InputError


class Adaptor(nn.Module):
    """Correction W_l = W0_l + w * s_l * Delta_l of every layer of one network.

    ``Delta_l = (alpha / rank) B_l A_l`` (LoRA), or a full matrix ``D_l`` if ``rank`` is None (training the
    base weights, the paper's "w/o LoRA"). ``s_l`` is the root mean square of W0_l over that of a
    Xavier-uniform matrix of its shape, so that one learning rate serves priors whose weights differ in size; a
    layer of zeros (the identity as a network) counts as Xavier-sized. Delta is zero at the start.

    Args:
        base: the frozen weights W0_l, (out, in) each.
        rank: LoRA rank r, or None.
        alpha: LoRA scaling numerator.
        seed: of the Kaiming-uniform(sqrt 5) start of A.
    """

    def __init__(self, base: Sequence[Tensor], rank: int | None = 16, alpha: float = 16.0, seed: int = 0):
        super().__init__()
        if rank is not None and (not isinstance(rank, int) or rank < 1):
            raise InputError(f"adaptor rank must be a positive integer or null (full matrices), not {rank!r}")
        self.rank, self.alpha = rank, float(alpha)
        self.weight = 1.0
        """The multiplier w of the correction: 1 as trained, 0 the prior, between them an interpolation."""
        generator = torch.Generator().manual_seed(seed)
        self.A, self.B, self.D = nn.ParameterList(), nn.ParameterList(), nn.ParameterList()
        self.scales: list[float] = []
        for W0 in base:
            rows, columns = W0.shape
            size = float(W0.detach().square().mean().sqrt()) / (2 / (rows + columns)) ** 0.5
            self.scales.append(size or 1.0)
            if rank is None:
                self.D.append(nn.Parameter(torch.zeros_like(W0)))
                continue
            bound = columns**-0.5
            A = (2 * torch.rand(rank, columns, generator=generator) - 1) * bound
            self.A.append(nn.Parameter(A.to(W0)))
            self.B.append(nn.Parameter(W0.new_zeros(rows, rank)))

    def deltas(self) -> tuple[Tensor, ...]:
        """The corrections s_l Delta_l, without the multiplier w."""
        if self.rank is None:
            return tuple(s * D for s, D in zip(self.scales, self.D, strict=True))
        factor = self.alpha / self.rank
        return tuple(s * factor * (B @ A) for s, A, B in zip(self.scales, self.A, self.B, strict=True))

    def forward(self, base: Sequence[Tensor]) -> tuple[Tensor, ...]:
        """Merged weights, differentiable in the adaptor's parameters."""
        return tuple(W0 + self.weight * delta for W0, delta in zip(base, self.deltas(), strict=True))
