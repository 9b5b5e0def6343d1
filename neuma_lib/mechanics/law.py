"""Interfaces of constitutive laws, analytic and neural.

A material model (paper, Sec. 3.2) is a pair of an *elasticity*, which maps the deformation gradient to a stress, and a
*plasticity*, which projects the trial deformation gradient to the admissible elastic region. Both have an explicit
adjoint, so that a rollout is differentiated by one reverse loop without an autograd graph.

The weights are an argument. A rollout calls ``law.weights()`` once (which merges LoRA), uses the same tensors at every
step and returns their gradients to autograd once.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from neuma_lib.errors import NonFiniteError
from neuma_lib.mechanics.catalogue import register, stiffest, viscous_stiffness

if TYPE_CHECKING:
    from neuma_lib.mechanics.fields import Field
    from neuma_lib.mechanics.viscosity import Viscosity

Weights = tuple[Tensor, ...]
AdjointPrecision = Literal["single", "half"]


class Constitutive(nn.Module):
    """A pointwise map of deformation gradients, (N, 3, 3) -> (N, 3, 3), differentiable in F and its weights.

    A subclass implements :meth:`response` in differentiable torch and may override the rest with faster code.
    """

    capturable = False
    """Whether `evaluate` and `vjp` can be recorded in a CUDA graph: they read nothing from the device and reuse all
    scratch memory."""
    native = False
    """Whether `evaluate` and `vjp` are kernels, with `response` as their reference, instead of torch."""
    loops = False
    """Whether `kernel` provides these for a loop over steps without Python."""
    native_rows = False
    """Whether the law is one of `analytic_kernels`, which `kernel_rows` describes."""
    keeps_singular_values = False
    """Whether these kernels can keep singular values for the adjoint (`analytic_kernels.new_cache`)."""
    shares_singular_values = False
    """Whether the kernel of a stress can read those that the kernel of the return map before it has kept."""
    identity = False
    """Whether the result is always F."""
    adjoint_precision: AdjointPrecision = "single"
    """Precision of the matrix products in `vjp`. "half" uses factors of 11 bits and sums them in float32, for laws
    with such kernels."""

    part: ClassVar[str]
    named: ClassVar[dict[str, type]]
    """Subclasses by name."""

    def __init_subclass__(cls, name: str | None = None, **options: Any):
        """``class Mine(Elasticity, name="mine")`` gives a law a name for specifications.

        Its ``constants``, units and bounds by name, are those of the specification. They are arguments of ``__init__``.
        """
        super().__init_subclass__(**options)
        if name is not None:
            if not cls.__module__.startswith("neuma_lib."):
                register(cls.part, name, getattr(cls, "constants", {}), cls.__module__)
            cls.named[name] = cls

    def graph_key(self) -> Hashable:
        """Key that is equal for laws that can share recorded graphs because they differ only in weights."""
        return self

    def weights(self) -> Weights:
        """Tensors that a rollout differentiates, as a differentiable function of the parameters."""
        return ()

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        """Differentiable evaluation in torch, F (N, 3, 3) -> (N, 3, 3)."""
        raise NotImplementedError

    def forward(self, F: Tensor) -> Tensor:
        """Differentiable evaluation with the module's own weights."""
        return self.response(F, self.weights())

    def evaluate(self, F: Tensor, weights: Weights, out: Tensor | None = None) -> Tensor:
        """Evaluation without gradient. ``out`` (N, 3, 3), not an alias of F, receives the result if given."""
        with torch.no_grad():
            value = self.response(F, weights)
        return value if out is None else out.copy_(value)

    def evaluate_with_cache(
        self, F: Tensor, weights: Weights, out: Tensor | None = None, cache: Any = None
    ) -> tuple[Tensor, Any]:
        """As `evaluate`, and an opaque cache of intermediate values for `vjp`, or None for laws without one.

        A cache owns its memory. One that is no longer needed can be passed as ``cache``, for the same number of rows,
        to be overwritten.
        """
        return self.evaluate(F, weights, out), None

    def vjp(
        self,
        F: Tensor,
        weights: Weights,
        grad_out: Tensor,
        cache: Any = None,
        grad_F: Tensor | None = None,
        grad_weights: Weights | None = None,
    ) -> tuple[Tensor, Weights]:
        """Vector-Jacobian product at F.

        Args:
            F, weights: arguments of :meth:`evaluate`.
            grad_out: (N, 3, 3) gradient of a scalar with respect to the result.
            cache: result of :meth:`evaluate_with_cache` at the same F and weights; None recomputes.
            grad_F: (N, 3, 3) buffer that receives the first result if given.
            grad_weights: accumulators shaped like the weights, or the result of :meth:`accumulators`. If given, the
                gradients are added to them.

        Returns:
            Gradient with respect to F, and one gradient per weight (``grad_weights`` if given).
        """
        with torch.enable_grad():
            leaves = [F.detach().requires_grad_(), *(w.detach().requires_grad_() for w in weights)]
            value = self.response(leaves[0], tuple(leaves[1:]))
            if value.requires_grad:
                grads = torch.autograd.grad(value, leaves, grad_out, allow_unused=True)
            else:
                grads = (None,) * len(leaves)
        grads = [torch.zeros_like(leaf) if g is None else g for g, leaf in zip(grads, leaves, strict=True)]
        result = grads[0] if grad_F is None else grad_F.copy_(grads[0])
        if grad_weights is None:
            return result, tuple(grads[1:])
        for total, grad in zip(grad_weights, grads[1:], strict=True):
            total.add_(grad)
        return result, grad_weights

    def kernel_rows(self, F: Tensor, weights: Weights) -> Tensor:
        """Rows for the kernels of `analytic_kernels` of the dtype and device of F."""
        raise NotImplementedError

    def kernel(self, F: Tensor, weights: Weights, backward: bool) -> tuple[Any, dict[str, Any]]:
        """The kernel of `evaluate` or `vjp` for a CPU, and its arguments by name except for F, the gradients, the cache
        and the result, for laws with `loops`."""
        raise NotImplementedError

    def cache_shape(self, F: Tensor, weights: Weights) -> tuple[int, ...]:
        """Shape of the cache of these kernels on a CPU."""
        raise NotImplementedError

    def accumulators(self, F: Tensor, grad_weights: Weights) -> Weights:
        """Zero buffers to which many calls of `vjp` for F (N, 3, 3) add most cheaply, to be reduced by `add_up`.

        By default ``grad_weights`` itself.
        """
        return grad_weights

    def add_up(self, accumulators: Weights, weights: Weights, grad_weights: Weights) -> None:
        """Add the contents of the buffers of :meth:`accumulators` to ``grad_weights``, the gradients of ``weights``."""


class Elasticity(Constitutive):
    """Deformation gradient F -> Kirchhoff stress tau = P F^T [Pa], both (N, 3, 3) (paper Eq. 4)."""

    part = "elasticity"
    named: ClassVar[dict[str, type]] = {}


class Plasticity(Constitutive):
    """Trial deformation gradient F_trial -> elastic deformation gradient F, both (N, 3, 3) (paper Eq. 6)."""

    part = "plasticity"
    named: ClassVar[dict[str, type]] = {}


class Law(nn.Module):
    """A material model: elasticity and plasticity, with a name for messages, and optionally a viscous part.

    Attributes:
        viscosity: spring and dashpot parallel to the elasticity (`neuma_lib.mechanics.viscosity`), or None.
        field: factor on all stresses along the body (`neuma_lib.mechanics.fields`), or None. Simulations apply it. The
            stresses of this class are those of the factor 1.
        grid: cells along the unit cube of the simulation that it was learned in, whose discretisation error it has
            absorbed; None if it does not depend on a grid. Simulations on another grid warn.
    """

    grid: int | None = None

    def __init__(
        self,
        elasticity: Elasticity,
        plasticity: Plasticity,
        name: str = "law",
        viscosity: Viscosity | None = None,
        field: Field | None = None,
    ):
        super().__init__()
        self.elasticity = elasticity
        self.plasticity = plasticity
        self.name = name
        self.viscosity = viscosity
        self.field = field

    @classmethod
    def from_spec(cls, spec: Mapping[str, Any], dt: float | None = None) -> Law:
        """An analytic law from the names and constants of its parts (`analytic_law`).

        Args:
            spec: ``elasticity`` and optionally ``plasticity``, ``viscosity`` and ``field``, each with its ``name`` and
                constants in SI units.
            dt: time step of the simulation [s], required by rate-dependent parts.

        Raises:
            InputError: a part, name or constant is unknown or missing, or a constant is out of bounds.

        Example:
            >>> Law.from_spec({"elasticity": {"name": "neo_hookean", "E": 1e5, "nu": 0.3}}).name
            'neo_hookean + identity'
        """
        return _imported("mechanics.analytic").analytic_law(spec, dt)

    @classmethod
    def load(cls, path: str | Path, dt: float | None = None) -> Law:
        """A law from a file of `save`, a prior, or a released NCLaw or NeuMA network (`neuma_lib.io.laws.load_law`).

        Args:
            path: ``.safetensors`` or ``.pt``.
            dt: time step of the simulation [s]. None: that of the training.

        Raises:
            InputError: the file is missing or damaged, or the law holds at another time step only.
        """
        return _imported("io.laws").load_law(path, dt=dt)

    def save(self, path: str | Path, about: Mapping[str, Any]) -> None:
        """Write the complete law to one ``.safetensors`` file, for `load`.

        Args:
            about: what is known of its origin, with the keys of `neuma_lib.io.exported`: at least ``dt``, the time step
                of its training [s], or None for a law that does not depend on it.
        """
        known = {"dt": None, **about}
        _imported("io.laws").save_law(path, self, _imported("io.exported").about_law(self, **known))

    def kirchhoff(self, F: Tensor) -> Tensor:
        """Kirchhoff stress tau [Pa] of trial deformation gradients after the return map, both (N, 3, 3). The viscous
        part, which depends on the past, adds nothing.

        Differentiable in F and the weights, in the precision of F, as a module of other solvers.
        """
        elastic, plastic = (tuple(w.to(F) for w in own) for own in self.weights())
        return self.elasticity.response(self.plasticity.response(F, plastic), elastic)

    def first_piola(self, F: Tensor) -> Tensor:
        """First Piola-Kirchhoff stress P = tau F^-T [Pa], (N, 3, 3), of `kirchhoff`."""
        return torch.linalg.solve(F, self.kirchhoff(F).mT).mT

    def tangent(self, F: Tensor) -> Tensor:
        """Consistent tangent dP_ij / dF_kl [Pa], (N, 3, 3, 3, 3), of `first_piola`. Detached."""
        F = F.detach()
        elastic, plastic = (tuple(w.detach().to(F) for w in own) for own in self.weights())
        E, plastic_cache = self.plasticity.evaluate_with_cache(F, plastic)
        tau, cache = self.elasticity.evaluate_with_cache(E, elastic)
        slopes = []
        for unit in torch.eye(9, dtype=F.dtype, device=F.device).reshape(9, 1, 3, 3):
            grad = self.elasticity.vjp(E, elastic, unit.expand_as(F).contiguous(), cache)[0]
            slopes.append(self.plasticity.vjp(F, plastic, grad, plastic_cache)[0])
        by_F = torch.stack(slopes, dim=1).unflatten(1, (3, 3))  # d tau_ij / dF_kl
        inverse = torch.linalg.inv(F)
        P = tau @ inverse.mT
        return torch.einsum("nimkl,njm->nijkl", by_F, inverse) - torch.einsum("nil,njk->nijkl", P, inverse)

    def weights(self) -> tuple[Weights, Weights]:
        """Weights of the elasticity and of the plasticity."""
        return self.elasticity.weights(), self.plasticity.weights()

    def set_adjoint_precision(self, precision: AdjointPrecision) -> None:
        """Set :attr:`Constitutive.adjoint_precision` of both parts."""
        for part in (self.elasticity, self.plasticity):
            part.adjoint_precision = precision

    def longitudinal_modulus(self) -> float:
        """Largest eigenvalue of the acoustic tensor Q_ik = n_j (d tau_ij / d F_kl) n_l at F = I over n [Pa].

        For an isotropic law this is the P-wave modulus lam + 2 mu. Computed by one-sided differences in float64 along
        26 directions n, because a neural law may be anisotropic and sorted singular values have a kink at F = I.
        """
        step = 1e-5
        ticks = torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)
        n = torch.cartesian_prod(ticks, ticks, ticks)
        n = n[n.norm(dim=1) > 0]
        n = n / n.norm(dim=1, keepdim=True)
        eye = torch.eye(3, dtype=torch.float64)
        H = torch.einsum("ka,dl->dakl", eye, n)  # displacement gradient e_a (x) n
        F = torch.cat([eye + step * H.reshape(-1, 3, 3), eye[None]])
        weights = self.elasticity.weights()
        device = weights[0].device if weights else torch.device("cpu")
        tau = self.elasticity.evaluate(F.to(device), tuple(w.detach().double() for w in weights)).cpu()
        tangent = ((tau[:-1] - tau[-1]) / step).reshape(len(n), 3, 3, 3)
        Q = torch.einsum("daij,dj->dia", tangent, n)
        if not torch.isfinite(Q).all():
            raise NonFiniteError("wave speed", f"the tangent of law {self.name!r} at F = I is not finite")
        return float(torch.linalg.eigvalsh(0.5 * (Q + Q.mT)).max())

    def wave_speed(self, rho: float) -> float:
        """Largest speed of small elastic waves at F = I [m/s], for density rho [kg/m^3], anywhere in the body.

        With a viscous part, that of an elastic law with the same limit of the time step
        (`catalogue.viscous_stiffness`).
        """
        modulus = max(self.longitudinal_modulus(), 0.0)
        if self.viscosity is not None:
            modulus += viscous_stiffness({key: float(v) for key, v in self.viscosity.values.items()})
        return (stiffest(self.field and self.field.values) * modulus / rho) ** 0.5


def _imported(module: str) -> ModuleType:
    """A module that imports this one. It is imported by name, because laws do not depend on the formats of files."""
    return import_module(f"neuma_lib.{module}")
