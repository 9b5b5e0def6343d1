"""Low-rank adaptor (the paper's Delta M, Sec. 3.2): the trained correction of a frozen prior law."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from neuma_lib.errors import InputError
from neuma_lib.mechanics.law import Constitutive, Law, Weights

LAYER_KEYS = ("layers.0.fc.weight", "layers.1.fc.weight", "final_layer.fc.weight")
"""Names of the three matrices of a network in files, as in NCLaw's checkpoints."""


def layers_of(state: Mapping[str, Tensor], part: str, where: str) -> Weights:
    """The three matrices of a part of a law, in float32, from the tensors of :meth:`AdaptableLaw.prior_state`.

    Raises:
        InputError: a tensor is missing.
    """
    keys = [f"{part}.{key}" for key in LAYER_KEYS]
    missing = [key for key in keys if key not in state]
    if missing:
        raise InputError(where, f"weights {', '.join(missing)} are missing")
    return tuple(state[key].float() for key in keys)


class Adaptor(nn.Module):
    """Correction W_l = W0_l + w * s_l * Delta_l of every layer of one network (Delta M of paper Eq. 3).

    ``Delta_l = (alpha / rank) B_l A_l`` (LoRA), or a full matrix ``D_l`` if ``rank`` is None (the paper's "w/o
    LoRA"). ``s_l`` is the root mean square of W0_l divided by that of a Xavier-uniform matrix of the same shape (1
    for a zero matrix), so that one learning rate suits priors of different weight magnitudes. Delta is initially zero.

    Args:
        base: frozen weights W0_l, (out, in) each.
        rank: LoRA rank r, or None.
        alpha: LoRA scaling numerator.
        seed: seed of the Kaiming-uniform(sqrt 5) initialisation of A.
    """

    def __init__(self, base: Sequence[Tensor], rank: int | None = 16, alpha: float = 16.0, seed: int = 0):
        super().__init__()
        if rank is not None and (not isinstance(rank, int) or rank < 1):
            problem = f"{rank!r} must be a positive integer, or null for full matrices"
            raise InputError("adaptor.rank", problem)
        self.rank, self.alpha = rank, float(alpha)
        self.weight = 1.0
        """Multiplier w of the correction: 1 is the trained law, 0 the prior."""
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
    """A network with frozen base weights and an optional adaptor."""

    base: nn.ParameterList
    adaptor: Adaptor | None

    def freeze(self, weights: Weights) -> None:
        """Set copies of ``weights`` as the base and remove the adaptor."""
        self.base = nn.ParameterList(nn.Parameter(w.detach().clone(), requires_grad=False) for w in weights)
        self.adaptor = None

    def weights(self) -> Weights:
        return tuple(self.base) if self.adaptor is None else self.adaptor(tuple(self.base))


class AdaptableLaw(Law):
    """A law with networks. Only the parameters of an attached adaptor are trainable."""

    @property
    def parts(self) -> dict[str, AdaptableConstitutive]:
        """The networks by name, without parts that have none (the identity as plasticity)."""
        both = {"elasticity": self.elasticity, "plasticity": self.plasticity}
        return {name: part for name, part in both.items() if isinstance(part, AdaptableConstitutive)}

    def attach_adaptor(self, rank: int | None = 16, alpha: float = 16.0, seed: int = 0) -> None:
        """Attach a new adaptor, initially zero, to each network."""
        for offset, part in enumerate(self.parts.values()):
            part.adaptor = Adaptor(tuple(part.base), rank, alpha, seed=2 * seed + offset)

    def set_adaptor_weight(self, weight: float) -> None:
        """Interpolate between the prior (0) and the adapted law (1), or extrapolate."""
        for part in self.parts.values():
            if part.adaptor is None:
                raise InputError("adaptor.weight", f"law {self.name!r} has no adaptor")
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
        """Attach an adaptor with the given tensors. Raises InputError if they do not match the rank."""
        self.attach_adaptor(rank, alpha)
        for name, part in self.parts.items():
            own = {key[len(name) + 1 :]: value for key, value in state.items() if key.startswith(name + ".")}
            try:
                part.adaptor.load_state_dict(own)
            except RuntimeError as error:
                reason = " ".join(str(error).split())
                raise InputError(f"adaptor.{name}", f"tensors do not match rank {rank}: {reason}") from None

    def prior_state(self) -> dict[str, Tensor]:
        """Merged weights by the names of :data:`LAYER_KEYS`, prefixed by the part."""
        return {
            f"{name}.{key}": weight.detach().clone().contiguous()
            for name, part in self.parts.items()
            for key, weight in zip(LAYER_KEYS, part.weights(), strict=True)
        }
