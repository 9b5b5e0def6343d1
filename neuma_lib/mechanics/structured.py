"""Structured laws: a learned correction of an analytic law that stays isotropic and bounded.

With F = U diag(sigma) V^T, a stress is U diag(y) U^T and a return map U diag(y) V^T. For any weights both are
frame-indifferent, isotropic and coaxial, and the stress is symmetric. With e = log sigma, t = tr e and s = |dev e|^2, a
network with two hidden layers of width 16 maps the `invariants` of e to a few outputs n, bounded by :data:`LIMIT`, that
modify an analytic base law as follows.

**Elasticity, form "stretch".** Let p be the mean stress of the base and 2 mu dev f(sigma_i) its deviator. Then

    tau_i = exp(n0) p + 2 mu exp(n1) (dev f_k)_i,    f_k(x) = integral of f'(z) z^k dz from 1 to x,

with k(n2) in (-1, 3). f_k increases where f does, so the correction preserves the Baker-Ericksen inequality of the base
(everywhere for ``hencky`` and ``neo_hookean``, for stretches above 1/2 for ``fixed_corotated``). For ``hencky``,
f = log and dev tau = 2 G dev (sigma^k - 1) / k. This form has no energy. The work in a closed cycle is that of
tau - tau_base, so at most its largest norm times the length of the cycle in e.

**Elasticity, form "energy".** tau_i = d psi / d e_i with psi = exp(n0) psi_volume + exp(n1) psi_shear, two non-negative
parts of the energy of the base. Cycles conserve energy, but stresses need not be ordered like the stretches.

**Plasticity.** A share v of t relaxes, then q = |dev e| slips by D along dev e, with compaction k or dilatancy d:

    t1 = (1 - a v) t,    q' = q - D,    t' = (1 - k D / q) t1 - d D,    D = a ramp(q - q_y) / (1 + m d),
    q_y = q0(n0) + m(n1) ramp(-t1),    a = 1 / (1 + r(n2)),
    v = g(n3) / LIMIT,    k = g(-n4) / LIMIT,    d = 2 mu m / K g(n4) / LIMIT.

Von Mises is m = r = 0, viscous flow r = viscosity / (mu dt), and a Bingham fluid has q0 > 0 as well. A granular base
(``drucker_prager``) has a cohesion c(n0) in place of q0: q_y = m (3 c - t1), and states beyond t1 = 3 c + d q return to
the apex of the cone, e' = c. A constant x > 0 of the base becomes x exp(n), and a zero constant becomes unit g(n), so
that friction, rate or cohesion can be learned from zero. g(n) (`from_zero`) is 0 for n <= 0 and grows exponentially up
to LIMIT, because such constants span orders of magnitude: v = 0.01 per step removes all pressure within some hundred
steps, and a fluid with a yield strain of 0.001 hardly flows. The first step of training must not reach such values.

The bases preserve volume (v = k = d = 0). A v that starts at some pressure is a crush cap, a v in tension is a tensile
strength, and k near 1 returns towards e = 0, as `CrushableFoam` does. t is the elastic part, so dilatancy raises the
pressure: slip at a = 1 ends on the cone at the new pressure, where m = 3 K alpha(phi) / (2 mu) and d = 3 alpha(psi)
give `CohesiveDruckerPrager`.

For any weights 0 <= q' <= q, t' lies between 0 and t unless n4 > 0, and d is at most that of flow normal to the cone,
so the Hencky energy mu q^2 + K t^2 / 2 of the base never grows. With other elastic stresses tau, no return adds energy
if tau . dev e >= 0, as for stresses ordered like the stretches, and if tr tau has the sign of t, except that dilatancy
under a pressure p may add up to p d D.

A last layer of zeros, the start of training and an adaptor weight of 0, reproduces the base to round-off. The plastic
bases are ``identity`` (elastic, no network), ``von_mises``, ``drucker_prager`` and ``viscous_flow``.
"""

import math
from collections.abc import Hashable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from neuma_lib.errors import InputError
from neuma_lib.mechanics import structured_kernels as kernels
from neuma_lib.mechanics.adaptor import AdaptableConstitutive, AdaptableLaw, layers_of
from neuma_lib.mechanics.analytic import analytic_law, name_of, specification
from neuma_lib.mechanics.catalogue import lame
from neuma_lib.mechanics.elasticity import STRETCH_MIN, AnalyticElasticity, FixedCorotated, Hencky, NeoHookean
from neuma_lib.mechanics.isotropic import PAIRS, Quotients, coaxial_deformation, coaxial_stress
from neuma_lib.mechanics.law import Elasticity, Plasticity, Weights
from neuma_lib.mechanics.plasticity import DruckerPrager, Identity, ViscousFlow, VonMises, hencky_strain
from neuma_lib.mechanics.singular_values import rotation_and_singular_values
from neuma_lib.mechanics.structured_kernels import (
    COHESION_UNIT,
    GROWTH,
    INVARIANTS,
    LIMIT,
    LODE,
    SMOOTH,
    STRAIN,
    WIDTH,
)

FORMS = {"stretch": 3, "energy": 2}
"""Number of network outputs for each form of elasticity."""
PLASTIC_OUTPUTS = 5
# Shear function f = sum of c (x^p - 1) / p over (c, p), log x for p = 0. The deviator of the base is 2 mu dev f.
SHEAR_TERMS: dict[type[AnalyticElasticity], tuple[tuple[float, float], ...]] = {
    Hencky: ((1.0, 0.0),),
    NeoHookean: ((1.0, 2.0),),
    FixedCorotated: ((2.0, 2.0), (-1.0, 1.0)),
}
FIRST, SECOND = map(list, zip(*PAIRS, strict=True))
THIRD = [3 - i - j for i, j in PAIRS]


def shapes(outputs: int) -> tuple[tuple[int, int], ...]:
    """Shapes of the three matrices of a network; the last column of each is the bias."""
    return (WIDTH, INVARIANTS + 1), (WIDTH, WIDTH + 1), (outputs, WIDTH + 1)


def initial_weights(outputs: int, seed: int) -> Weights:
    """Two Xavier-uniform layers and a last layer of zeros."""
    generator = torch.Generator().manual_seed(seed)
    *hidden, last = shapes(outputs)
    weights = [(2 * torch.rand(s, generator=generator) - 1) * (6 / sum(s)) ** 0.5 for s in hidden]
    return (*weights, torch.zeros(last))


def invariants(strain: Tensor) -> Tensor:
    """(N, 3) smooth symmetric functions of the logarithmic strains e (N, 3).

    t; the size sqrt(s + SMOOTH^2) - SMOOTH of the deviator; its Lode part LODE det dev e / (s + SMOOTH^2) in
    [-sqrt(s), sqrt(s)].
    """
    trace = strain.sum(1)
    deviator = strain - trace[:, None] / 3
    s = (deviator**2).sum(1)
    rounded = s + SMOOTH**2
    size = s / (rounded.sqrt() + SMOOTH)  # avoids cancellation
    return torch.stack([trace, size, LODE * deviator.prod(1) / rounded], dim=1)


def from_zero(n: Tensor) -> Tensor:
    """g(n) = LIMIT expm1(GROWTH ramp(n)) / expm1(GROWTH LIMIT), with the right derivative at n = 0."""
    return LIMIT / math.expm1(GROWTH * LIMIT) * (GROWTH * n.clamp(min=0)).expm1()


def _bend(x: Tensor) -> Tensor:
    """The activation x / sqrt(1 + x^2), bounded and without an exponential."""
    return x * torch.rsqrt(1 + x * x)


def _slope(x: Tensor) -> Tensor:
    return torch.rsqrt(1 + x * x) ** 3


def _layers(z: Tensor, weights: Weights) -> list[Tensor]:
    """Arguments of the three activations, the last divided by LIMIT."""
    W0, W1, W2 = weights
    a0 = pad(z / STRAIN, (0, 1), value=1.0) @ W0.mT
    a1 = pad(_bend(a0), (0, 1), value=1.0) @ W1.mT
    return [a0, a1, pad(_bend(a1), (0, 1), value=1.0) @ W2.mT / LIMIT]


def network(z: Tensor, weights: Weights) -> Tensor:
    """Outputs n (N, k) in (-LIMIT, LIMIT) for invariants z (N, 3)."""
    return LIMIT * _bend(_layers(z, weights)[-1])


def network_with_jacobian(z: Tensor, weights: Weights) -> tuple[Tensor, Tensor]:
    """n (N, k) and d n / d z (N, k, 3)."""
    a0, a1, a2 = _layers(z, weights)
    W0, W1, W2 = weights
    J = _slope(a0)[..., None] * (W0[:, :-1] / STRAIN)
    J = _slope(a1)[..., None] * (W1[:, :-1] @ J)
    return LIMIT * _bend(a2), _slope(a2)[..., None] * (W2[:, :-1] @ J)


def _sinhc(x: Tensor) -> Tensor:
    """sinh(x) / x, smooth at zero in value and derivative."""
    small = x.abs() < 0.5
    square = torch.where(small, x, 0.0) ** 2
    series = torch.ones_like(x)
    for n in range(8, 0, -1):  # the next term is 0.5^18 / 19!, below round-off
        series = 1 + square / ((2 * n) * (2 * n + 1)) * series
    large = torch.where(small, 1.0, x)
    return torch.where(small, series, large.sinh() / large)


class _Pairs:
    """Divided differences over the pairs (i, j) of `PAIRS` of singular values sigma (N, 3), (N, 3 pairs) each.

    ``clamped`` are those of max(sigma, STRETCH_MIN) and ``log`` those of its logarithm, ``gap`` and ``mean`` the
    difference and the mean of the two logarithms. The only cancellation is in differences of singular values.
    """

    def __init__(self, sigma: Tensor):
        self.si, self.sj = sigma[:, FIRST], sigma[:, SECOND]
        self.ci, self.cj = self.si.clamp(min=STRETCH_MIN), self.sj.clamp(min=STRETCH_MIN)
        difference, clamped_difference = self.si - self.sj, self.ci - self.cj
        same = difference == 0
        inside = (self.sj > STRETCH_MIN).to(sigma)
        self.clamped = torch.where(same, inside, clamped_difference / torch.where(same, 1.0, difference))
        ratio = clamped_difference / self.cj
        self.gap, self.mean = ratio.log1p(), 0.5 * (self.ci * self.cj).log()
        equal = ratio == 0
        self.log = self.clamped / self.cj * torch.where(equal, 1.0, self.gap / torch.where(equal, 1.0, ratio))


class StructuredConstitutive(AdaptableConstitutive):
    """A network that corrects an analytic law. :mod:`structured_kernels` evaluates it, with `response` as reference."""

    capturable = True
    native = True
    loops = True
    keeps_singular_values = True
    shares_singular_values = True
    network_kernel: tuple[str, kernels.Constants]
    """Kind of the kernel, and the constants of the law."""

    def graph_key(self) -> Hashable:
        return type(self), self.network_kernel

    def outputs(self, z: Tensor, weights: Weights) -> Tensor:
        """Outputs of the network (N, k) for invariants z (N, 3)."""
        return network(z, weights)

    def kernel(self, F, weights, backward):
        return kernels.kernel_of(*self.network_kernel, F, weights, backward)

    def cache_shape(self, F, weights):
        return kernels.cache_shape(F)

    def evaluate(self, F: Tensor, weights: Weights, out: Tensor | None = None) -> Tensor:
        return kernels.evaluate(*self.network_kernel, F, weights, out)

    def evaluate_with_cache(self, F, weights, out=None, cache=None):
        cache = kernels.new_cache(F) if cache is None else cache
        return kernels.evaluate(*self.network_kernel, F, weights, out, cache), cache

    def vjp(self, F, weights, grad_out, cache=None, grad_F=None, grad_weights=None):
        return kernels.vjp(*self.network_kernel, F, weights, grad_out, cache, grad_F, grad_weights)


class StructuredElasticity(StructuredConstitutive, Elasticity):
    """A corrected isotropic elasticity, see the module.

    Args:
        base: analytic law with numbers as constants.
        form: "stretch" or "energy".
        weights: three matrices of `shapes`, by default `initial_weights` of ``seed``.

    Raises:
        InputError: the form or the base is not supported, or the weights have other shapes.
    """

    def __init__(
        self, base: AnalyticElasticity, form: str = "stretch", weights: Weights | None = None, seed: int = 0
    ):
        super().__init__()
        if form not in FORMS:
            raise InputError("form", f"{form!r} must be {' or '.join(map(repr, FORMS))}")
        if type(base) not in SHEAR_TERMS:
            raise _unsupported("elasticity", base, "hencky, neo_hookean, fixed_corotated")
        self.analytic, self.form = base, form
        self.mu, self.lam = (float(x) for x in lame(base.values["E"], base.values["nu"]))
        self.terms = SHEAR_TERMS[type(base)]
        if form == "energy" and self.lam < 0 and type(base) is not Hencky:
            raise InputError("elasticity.nu", f"{base.values['nu']:g} must be >= 0 for the form 'energy'")
        base_index = kernels.BASES.index(name_of(base))
        self.network_kernel = form, kernels.Constants(base_index, (self.mu, self.lam, 0.0, 0.0))
        self.freeze(_checked("elasticity", weights, FORMS[form], seed))

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        _, sigma = rotation_and_singular_values(F)
        return coaxial_stress(F, *self.principal(sigma, weights))

    def principal(self, sigma: Tensor, weights: Weights) -> tuple[Tensor, Quotients]:
        """Principal Kirchhoff stresses (N, 3) [Pa] of principal stretches (N, 3), and their divided differences."""
        return (self._stretch_form if self.form == "stretch" else self._energy_form)(sigma, weights)

    def _stretch_form(self, sigma, weights):
        strain = sigma.clamp(min=STRETCH_MIN).log()
        n0, n1, n2 = self.outputs(invariants(strain), weights).split(1, dim=1)
        shift = 3 * n2.expm1() / (n2.exp() + 3)
        shear = self._shear(sigma, strain, shift)
        mean = self.analytic.principal(sigma, self.mu, self.lam).mean(1, keepdim=True)
        modulus = 2 * self.mu * n1.exp()
        y = n0.exp() * mean + modulus * (shear - shear.mean(1, keepdim=True))

        def quotients(sigma):
            quotient = self._shear_quotient(_Pairs(sigma), shift.detach())
            return modulus.detach() * quotient, *_sums(y.detach(), sigma)

        return y, quotients

    def _shear(self, sigma: Tensor, strain: Tensor, shift: Tensor | float) -> Tensor:
        """f_k(sigma) (N, 3), continued below STRETCH_MIN with the slope of the base."""
        total, clamped = 0.0, sigma.clamp(min=STRETCH_MIN)
        for c, p in self.terms:
            half = 0.5 * (p + shift) * strain
            total = total + c * strain * half.exp() * _sinhc(half)
            if p:
                total = total + c / p * (sigma**p - clamped**p)
        return total

    def _shear_quotient(self, pairs: _Pairs, shift: Tensor | float) -> Tensor:
        """(N, 3 pairs) divided differences of `_shear`."""
        total = 0.0
        for c, p in self.terms:
            m = p + shift
            total = total + c * (m * pairs.mean).exp() * _sinhc(0.5 * m * pairs.gap) * pairs.log
            if p == 1:
                total = total + c * (1 - pairs.clamped)
            elif p == 2:
                total = total + 0.5 * c * (pairs.si + pairs.sj - (pairs.ci + pairs.cj) * pairs.clamped)
        return total

    def _energy_form(self, sigma, weights):
        strain = sigma.clamp(min=STRETCH_MIN).log()
        deviator = strain - strain.mean(1, keepdim=True)
        n, J = network_with_jacobian(invariants(strain), weights)
        volume, shear, volume_stress, shear_stress = self._energy_parts(sigma, deviator)
        factor = n.exp()
        # d psi / d (t, size, Lode part) through the network
        t, size, lode = ((factor * torch.stack([volume, shear], 1))[..., None] * J).sum(1).split(1, dim=1)
        s = (deviator**2).sum(1, keepdim=True)
        rounded = s + SMOOTH**2
        det = deviator.prod(1, keepdim=True)
        cofactor = torch.stack([deviator[:, j] * deviator[:, k] for j, k in ((1, 2), (0, 2), (0, 1))], dim=1)
        across = LODE / rounded * (cofactor + s / 6 - 2 * det / rounded * deviator)
        y = factor[:, :1] * volume_stress + factor[:, 1:] * shear_stress
        y = y + t + size * rounded.rsqrt() * deviator + lode * across
        modulus, size, lode, det, rounded, third = (
            x.detach() for x in (2 * self.mu * factor[:, 1:], size, lode, det, rounded, deviator[:, THIRD])
        )

        def quotients(sigma):
            pairs = _Pairs(sigma)
            along = size * rounded.rsqrt() - lode * LODE / rounded * (third + 2 * det / rounded)
            return modulus * self._shear_quotient(pairs, 0.0) + along * pairs.log, *_sums(y.detach(), sigma)

        return y, quotients

    def _energy_parts(self, sigma: Tensor, deviator: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Energies (N,) of volume and shear [Pa], and their principal stresses."""
        mu, lam = self.mu, self.lam
        if isinstance(self.analytic, Hencky):
            bulk, t = lam + 2 * mu / 3, sigma.clamp(min=STRETCH_MIN).log().sum(1)
            return bulk / 2 * t**2, mu * (deviator**2).sum(1), bulk * t[:, None], 2 * mu * deviator
        J = sigma.prod(1)
        if isinstance(self.analytic, FixedCorotated):
            volume, shear = (J - 1) ** 2, ((sigma - 1) ** 2).sum(1)
        else:
            log_J = J.clamp(min=STRETCH_MIN**3).log()
            volume, shear = log_J**2, 0.5 * ((sigma - 1) * (sigma + 1)).sum(1) - log_J
        stresses = (self.analytic.principal(sigma, *constants) for constants in ((0.0, lam), (mu, 0.0)))
        return lam / 2 * volume, mu * shear, *stresses


class StructuredPlasticity(StructuredConstitutive, Plasticity):
    """A corrected return map, see the module.

    Args:
        base: von Mises, Drucker-Prager or viscous flow, with numbers as constants.
        weights, seed: see `StructuredElasticity`.

    Raises:
        InputError: the base is not supported, or the weights have other shapes.
    """

    def __init__(self, base: Plasticity, weights: Weights | None = None, seed: int = 0):
        super().__init__()
        if type(base) not in (VonMises, DruckerPrager, ViscousFlow):
            raise _unsupported("plasticity", base, "identity, von_mises, drucker_prager, viscous_flow")
        self.analytic = base
        self.granular = isinstance(base, DruckerPrager)
        mu, lam = lame(base.values["E"], base.values["nu"])
        self.associated = 2 * mu / (lam + 2 * mu / 3)  # d / m of flow normal to the cone
        self.friction = base.slope(**base.values) if self.granular else 0.0
        self.threshold = base.values["cohesion"] if self.granular else base.values["yield_stress"] / (2 * mu)
        viscous = isinstance(base, ViscousFlow)
        self.rate = base.values["viscosity"] / (mu * base.values["dt"]) if viscous else 0.0
        constants = self.threshold, self.friction, self.rate, self.associated
        self.network_kernel = "return", kernels.Constants(int(self.granular), tuple(map(float, constants)))
        self.freeze(_checked("plasticity", weights, PLASTIC_OUTPUTS, seed))

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        _, sigma = rotation_and_singular_values(F)
        return coaxial_deformation(F, *self.principal(sigma, weights))

    def principal(self, sigma: Tensor, weights: Weights) -> tuple[Tensor, Quotients]:
        """Principal stretches (N, 3) after the return, sigma itself where nothing yields, and their divided
        differences."""
        trace, deviator, norm = hencky_strain(sigma)
        n = self.outputs(invariants(trace / 3 + deviator), weights)
        threshold = _corrected(self.threshold, n[:, :1], COHESION_UNIT)
        friction = _corrected(self.friction, n[:, 1:2], 1.0)
        fluidity = 1 / (1 + _corrected(self.rate, n[:, 2:3], 1.0))
        crush, dilation, compaction = (from_zero(x) / LIMIT for x in (n[:, 3:4], n[:, 4:], -n[:, 4:]))
        dilatancy = dilation * self.associated * friction
        relaxed = trace * (1 - fluidity * crush)  # t1
        if self.granular:
            shifted = relaxed - 3 * threshold
            limit = -friction * shifted
            torn = shifted > dilatancy * norm
        else:
            limit = threshold + friction * (-relaxed).clamp(min=0)
            torn = torch.zeros_like(trace, dtype=torch.bool)
        slips = ~torn & (norm > limit)
        share = fluidity / (1 + friction * dilatancy) * (1 - limit / torch.where(slips, norm, 1.0))
        share = torch.where(slips, share, 0.0)  # D / q
        after = relaxed * (1 - compaction * share) - dilatancy * share * norm  # t'
        returned = (after / 3 + deviator * (1 - share)).exp()
        apex = threshold.exp().expand_as(sigma) if self.granular else returned
        changed = torn | slips | (crush > 0)
        y = torch.where(changed, torch.where(torn, apex, returned), sigma)
        scale = torch.where(torn, 0.0, 1 - share).detach()

        def quotients(sigma):
            pairs, values = _Pairs(sigma), y.detach()
            product = values[:, FIRST] * values[:, SECOND]
            quotient = product.clamp(min=0).sqrt() * scale * _sinhc(0.5 * scale * pairs.gap) * pairs.log
            return torch.where(changed, quotient, 1.0), *_sums(values, sigma)

        return y, quotients


def _corrected(constant: float, n: Tensor, unit: float) -> Tensor:
    """constant exp(n), or unit g(n) if the constant is zero."""
    return constant * n.exp() if constant > 0 else unit * from_zero(n)


def _sums(y: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
    return y[:, FIRST] + y[:, SECOND], sigma[:, FIRST] + sigma[:, SECOND]


def _unsupported(part: str, base: AnalyticElasticity | Plasticity, choices: str) -> InputError:
    name = name_of(base) or type(base).__name__
    return InputError(f"{part}.name", f"{name} is no base of a structured law, which are {choices}")


def _checked(part: str, weights: Weights | None, outputs: int, seed: int) -> Weights:
    weights = initial_weights(outputs, seed) if weights is None else weights
    given = tuple(tuple(w.shape) for w in weights)
    if given != shapes(outputs):
        raise InputError(f"{part} weights", f"shapes {given} must be {shapes(outputs)}")
    return weights


class StructuredLaw(AdaptableLaw):
    """A corrected elasticity and plasticity. The identity as plasticity has no network."""

    elasticity: StructuredElasticity
    plasticity: StructuredPlasticity | Identity

    def specification(self) -> dict[str, Any]:
        """Form and base, for `structured_law`."""
        base = getattr(self.plasticity, "analytic", self.plasticity)
        parts = self.elasticity.analytic, base, self.viscosity, self.field
        return {"form": self.elasticity.form, **specification(*parts)}


def structured_law(
    spec: Mapping[str, Any],
    dt: float | None = None,
    state: Mapping[str, Tensor] | None = None,
    name: str | None = None,
    seed: int = 0,
) -> StructuredLaw:
    """Structured law whose base is the analytic law of a specification, equal to the base until it is trained.

    Args:
        spec: as in `analytic_law`, with numbers as constants, and the ``form`` of the elasticity (default "stretch").
        dt: time step [s], required by ``viscous_flow``.
        state: tensors of `StructuredLaw.prior_state`. By default the last layers are zero.
        name: name used in messages, by default derived from that of the base.
        seed: seed of the first layers if ``state`` is not given.

    Raises:
        InputError: as in `analytic_law`, or an unsupported base or form, or tensors that do not match.
    """
    spec = dict(spec)
    form = spec.pop("form", "stretch")
    base = analytic_law(spec, dt)

    def weights(part: str) -> Weights | None:
        return None if state is None else layers_of(state, part, "structured law")

    elasticity = StructuredElasticity(base.elasticity, form, weights("elasticity"), 2 * seed)
    plasticity = base.plasticity
    if not isinstance(plasticity, Identity):
        plasticity = StructuredPlasticity(plasticity, weights("plasticity"), 2 * seed + 1)
    return StructuredLaw(
        elasticity, plasticity, name or f"structured {base.name}", base.viscosity, base.field
    )
