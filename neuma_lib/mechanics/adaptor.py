"""Low-rank adaptor (the paper's Delta M, Sec. 3.2): the trained correction of a frozen prior; laws that take one."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from neuma_lib.errors import InputError
from neuma_lib.mechanics.law import Constitutive, Law, Weights

LAYER_KEYS = ("layers.0.fc.weight", "layers.1.fc.weight", "final_layer.fc.weight")
"""Names of the three matrices of a network in files, those of NCLaw's checkpoints."""


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


class AdaptableConstitutive(Constitutive):
    """A network of a few matrices with frozen base weights and, if one is attached, an adaptor."""

    isotropic = False
    """Whether the axes of the stretch do not matter, for any weights."""
    base: nn.ParameterList
    adaptor: Adaptor | None

    def freeze(self, weights: Weights) -> None:
        """Make copies of ``weights`` the base, without an adaptor."""
        self.base = nn.ParameterList(nn.Parameter(w.detach().clone(), requires_grad=False) for w in weights)
        self.adaptor = None

    def weights(self) -> Weights:
        return tuple(self.base) if self.adaptor is None else self.adaptor(tuple(self.base))


class AdaptableLaw(Law):
    """A law with networks; the adaptor, once attached, holds the only trainable parameters."""

    @property
    def parts(self) -> dict[str, AdaptableConstitutive]:
        """The networks by name; a part without one (a plasticity that is the identity) is left out."""
        both = {"elasticity": self.elasticity, "plasticity": self.plasticity}
        return {name: part for name, part in both.items() if isinstance(part, AdaptableConstitutive)}

    def attach_adaptor(self, rank: int | None = 16, alpha: float = 16.0, seed: int = 0) -> None:
        """Give the networks a fresh adaptor, zero at the start."""
        for offset, part in enumerate(self.parts.values()):
            part.adaptor = Adaptor(tuple(part.base), rank, alpha, seed=2 * seed + offset)

    def set_adaptor_weight(self, weight: float) -> None:
        """Interpolate between the prior (0) and the adapted law (1); also beyond."""
        for part in self.parts.values():
            if part.adaptor is None:
                raise InputError("the law has no adaptor whose weight could be set")
            part.adaptor.weight = float(weight)

    def adaptor_state(self) -> dict[str, Tensor]:
        """The adaptor's tensors by name ("elasticity.A.0", ...), for :meth:`load_adaptor_state`."""
        return {
            f"{name}.{key}": value.detach().clone()
            for name, part in self.parts.items()
            if part.adaptor is not None
            for key, value in part.adaptor.state_dict().items()
        }

    def load_adaptor_state(
        self, state: dict[str, Tensor], rank: int | None = 16, alpha: float = 16.0
    ) -> None:
        """Attach an adaptor with the given tensors.

        Raises:
            InputError: the tensors do not fit an adaptor of this rank.
        """
        self.attach_adaptor(rank, alpha)
        for name, part in self.parts.items():
            own = {key[len(name) + 1 :]: value for key, value in state.items() if key.startswith(name + ".")}
            try:
                part.adaptor.load_state_dict(own)
            except RuntimeError as error:
                raise InputError(f"adaptor of the {name} does not fit rank {rank}: {error}") from None

    def prior_state(self) -> dict[str, Tensor]:
        """Merged weights under the names of :data:`LAYER_KEYS`, prefixed by the part."""
        return {
            f"{name}.{key}": weight.detach().clone().contiguous()
            for name, part in self.parts.items()
            for key, weight in zip(LAYER_KEYS, part.weights(), strict=True)
        }
