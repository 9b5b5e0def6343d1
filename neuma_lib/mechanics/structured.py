"""Laws with the structure of a material: a learned correction of an analytic law that stays isotropic and bounded.

With F = U diag(sigma) V^T, a stress is U diag(y) U^T and a return map U diag(y) V^T, so both are frame-indifferent,
isotropic and coaxial, and the stress is symmetric, for any weights. With e = log sigma, t = tr e and s = |dev e|^2 a
network of two hidden layers of 16 reads the `invariants` of e and gives a few numbers n, bounded by
:data:`LIMIT`; they change the base, an analytic law with constants, as follows.

**Elasticity, form "stretch".** The base's mean stress p and the shear function f of one stretch, of which the base's
deviator is 2 mu dev f(sigma_i), become

    tau_i = exp(n0) p + 2 mu exp(n1) (dev f_k)_i,    f_k(x) = integral of f'(z) z^k dz from 1 to x,

with k(n2) in (-1, 3). f_k rises where f does, so larger stretches have larger stresses wherever the base says so
(Baker-Ericksen inequality: everywhere for ``hencky`` and ``neo_hookean``, among stretches above 1/2 for
``fixed_corotated``, whose own f falls below that). For ``hencky``, f = log, dev tau = 2 G dev (sigma^k - 1) / k. There
is no energy: a closed cycle does the work of the correction tau - tau_base alone, so at most its largest norm times the
length of the cycle in e.

**Elasticity, form "energy".** tau_i = d psi / d e_i of psi = exp(n0) psi_volume + exp(n1) psi_shear, two non-negative
parts of the base's energy: no cycle gains or loses energy, but stresses need not be ordered.

**Plasticity.** A share v of t relaxes, then q = |dev e| slips by D along dev e, which may compact (k) or dilate (d):

    t1 = (1 - a v) t,    q' = q - D,    t' = (1 - k D / q) t1 - d D,    D = a ramp(q - q_y) / (1 + m d),
    q_y = q0(n0) + m(n1) ramp(-t1),    a = 1 / (1 + r(n2)),
    v = g(n3) / LIMIT,    k = g(-n4) / LIMIT,    d = 2 mu m / K g(n4) / LIMIT.

Von Mises is m = r = 0, viscous flow r = viscosity / (mu dt), a Bingham fluid the same with q0 > 0. A granular base
(``drucker_prager``) has a cohesion c(n0) instead of q0: q_y = m (3 c - t1), and beyond t1 = 3 c + d q it is torn to the
tip of its cone, e' = c. A constant x > 0 of the base becomes x exp(n); one that is 0 becomes unit g(n), so that a base
without friction, rate or cohesion can learn some. g(n), `from_zero`, rises from 0 for n <= 0 to LIMIT as an exponential
does, since such constants lie orders of magnitude apart: v = 0.01 a step lets go all pressure within some hundred
steps, and a fluid with a yield strain of 0.001 hardly flows. A first step of training must not take it there.

The bases keep the volume (v = k = d = 0). A v that begins at some pressure is a crush cap, one that begins in tension
a tensile strength, and k near 1 returns towards e = 0, as `CrushableFoam` does. t is the elastic part, so that a body
which grows in shear is pressed: slip at a = 1 ends on the cone at its new pressure, where m = 3 K alpha(phi) / (2 mu)
and d = 3 alpha(psi) give `CohesiveDruckerPrager`.

For any weights 0 <= q' <= q, t' lies between 0 and t unless n4 > 0, and d is at most that of flow normal to the cone.
So mu q^2 + K t^2 / 2, the Hencky energy of the base's mu and K, never grows. With other elastic stresses tau, of a
corrected elasticity too, no return adds energy where tau . dev e >= 0, as with stresses ordered as the stretches, and
tr tau has the sign of t; but dilatancy under a pressure p may add up to p d D.

A last layer of zeros, where training starts and which an adaptor weight of 0 restores, leaves the base exactly
(to round-off). Bases are those named above with any of ``identity`` (stays elastic, has no network), ``von_mises``,
``drucker_prager`` and ``viscous_flow``.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from neuma_lib.errors import InputError
from neuma_lib.mechanics import structured_kernels as kernels
from neuma_lib.mechanics.adaptor import LAYER_KEYS, AdaptableConstitutive, AdaptableLaw
from neuma_lib.mechanics.analytic import NAMES, analytic_law, specification
from neuma_lib.mechanics.elasticity import (
    STRETCH_MIN,
    AnalyticElasticity,
    FixedCorotated,
    Hencky,
    NeoHookean,
)
from neuma_lib.mechanics.isotropic import PAIRS, Quotients, coaxial_deformation, coaxial_stress, lame
from neuma_lib.mechanics.law import Elasticity, Plasticity, Weights
from neuma_lib.mechanics.plasticity import (
    DruckerPrager,
    Identity,
    ViscousFlow,
    VonMises,
    hencky_strain,
)
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
"""Numbers that the network of each form of elasticity gives."""
PLASTIC_OUTPUTS = 5
# Shear function f = sum of c (x^p - 1) / p over (c, p), with log x for p = 0: the base's deviator is 2 mu dev f.
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
    """Two Xavier-uniform layers and a last one of zeros."""
    generator = torch.Generator().manual_seed(seed)
    *hidden, last = shapes(outputs)
    weights = [(2 * torch.rand(s, generator=generator) - 1) * (6 / sum(s)) ** 0.5 for s in hidden]
    return (*weights, torch.zeros(last))


def invariants(strain: Tensor) -> Tensor:
    """(N, 3) smooth symmetric functions of the logarithmic strains e (N, 3).

    t; the size sqrt(s + SMOOTH^2) - SMOOTH of the deviator; its Lode part LODE det dev e / (s + SMOOTH^2), which lies
    between -sqrt(s) and sqrt(s).
    """
    trace = strain.sum(1)
    deviator = strain - trace[:, None] / 3
    s = (deviator**2).sum(1)
    rounded = s + SMOOTH**2
    size = s / (rounded.sqrt() + SMOOTH)  # no difference of nearly equal numbers
    return torch.stack([trace, size, LODE * deviator.prod(1) / rounded], dim=1)


def from_zero(n: Tensor) -> Tensor:
    """g(n) = LIMIT expm1(GROWTH ramp(n)) / expm1(GROWTH LIMIT); its slope at n = 0 counts as that of n > 0."""
    return LIMIT / math.expm1(GROWTH * LIMIT) * (GROWTH * n.clamp(min=0)).expm1()


def _bend(x: Tensor) -> Tensor:
    """The activation x / sqrt(1 + x^2): bounded, and needs no exponential."""
    return x * torch.rsqrt(1 + x * x)


def _slope(x: Tensor) -> Tensor:
    return torch.rsqrt(1 + x * x) ** 3


def _layers(z: Tensor, weights: Weights) -> list[Tensor]:
    """Arguments of the three activations, the last in units of LIMIT."""
    W0, W1, W2 = weights
    a0 = pad(z / STRAIN, (0, 1), value=1.0) @ W0.mT
    a1 = pad(_bend(a0), (0, 1), value=1.0) @ W1.mT
    return [a0, a1, pad(_bend(a1), (0, 1), value=1.0) @ W2.mT / LIMIT]


def network(z: Tensor, weights: Weights) -> Tensor:
    """Outputs n (N, k), between -LIMIT and LIMIT, for invariants z (N, 3)."""
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
    for n in range(8, 0, -1):  # the next term is 0.5^18 / 19!, less than round-off
        series = 1 + square / ((2 * n) * (2 * n + 1)) * series
    away = torch.where(small, 1.0, x)
    return torch.where(small, series, away.sinh() / away)


class _Pairs:
    """Divided differences over the pairs (i, j) of `PAIRS` of singular values sigma (N, 3), (N, 3 pairs) each.

    ``clamped`` are those of max(sigma, STRETCH_MIN), ``log`` those of its logarithm, ``gap`` and ``mean`` the
    difference and the mean of the two logarithms. No differences of nearly equal numbers but of singular values.
    """

    def __init__(self, sigma: Tensor):
        self.si, self.sj = sigma[:, FIRST], sigma[:, SECOND]
        self.ci, self.cj = self.si.clamp(min=STRETCH_MIN), self.sj.clamp(min=STRETCH_MIN)
        apart, clamped_apart = self.si - self.sj, self.ci - self.cj
        same = apart == 0
        inside = (self.sj > STRETCH_MIN).to(sigma)
        self.clamped = torch.where(same, inside, clamped_apart / torch.where(same, 1.0, apart))
        ratio = clamped_apart / self.cj
        self.gap, self.mean = ratio.log1p(), 0.5 * (self.ci * self.cj).log()
        equal = ratio == 0
        self.log = self.clamped / self.cj * torch.where(equal, 1.0, self.gap / torch.where(equal, 1.0, ratio))


class StructuredConstitutive(AdaptableConstitutive):
    """A network around an analytic law. The kernels of :mod:`structured_kernels` do the work; `response` is their slow
    twin."""

    capturable = True
    kernel: tuple[str, kernels.Constants]
    """Which kernel, and what it knows beside the weights."""

    def graph_key(self) -> Hashable:
        return type(self), self.kernel

    def evaluate(self, F: Tensor, weights: Weights, out: Tensor | None = None) -> Tensor:
        return kernels.evaluate(*self.kernel, F, weights, out)

    def evaluate_with_cache(self, F, weights, out=None, cache=None):
        cache = kernels.new_cache(F) if cache is None else cache
        return kernels.evaluate(*self.kernel, F, weights, out, cache), cache

    def vjp(self, F, weights, grad_out, cache=None, grad_F=None, grad_weights=None):
        return kernels.vjp(*self.kernel, F, weights, grad_out, cache, grad_F, grad_weights)


class StructuredElasticity(StructuredConstitutive, Elasticity):
    """A corrected isotropic elasticity, see the module.

    Args:
        base: its analytic law, with numbers as constants.
        form: "stretch" or "energy".
        weights: three matrices of `shapes`; `initial_weights` of ``seed`` if not given.

    Raises:
        InputError: no such form, a base that has none, weights of other shapes.
    """

    isotropic = True

    def __init__(
        self, base: AnalyticElasticity, form: str = "stretch", weights: Weights | None = None, seed: int = 0
    ):
        super().__init__()
        if form not in FORMS:
            raise InputError(
                f"a structured elasticity has the form {' or '.join(map(repr, FORMS))}, not {form!r}"
            )
        if type(base) not in SHEAR_TERMS:
            raise InputError(_no_base("elasticity", "hencky, neo_hookean, fixed_corotated"))
        self.analytic, self.form = base, form
        self.mu, self.lam = (float(x) for x in lame(base.values["E"], base.values["nu"]))
        self.terms = SHEAR_TERMS[type(base)]
        if form == "energy" and self.lam < 0 and type(base) is not Hencky:
            raise InputError(
                f"the energy form needs nu >= 0, not {base.values['nu']:g}: its volume part is else negative"
            )
        base_number = kernels.BASES.index(NAMES[type(base)])
        self.kernel = form, kernels.Constants(base_number, (self.mu, self.lam, 0.0, 0.0))
        self.freeze(_checked(weights, FORMS[form], seed))

    def outputs(self, z: Tensor, weights: Weights) -> Tensor:
        """What the network gives (N, k) for invariants z (N, 3)."""
        return network(z, weights)

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        _, sigma = rotation_and_singular_values(F)
        return coaxial_stress(F, *self.principal(sigma, weights))

    def principal(self, sigma: Tensor, weights: Weights) -> tuple[Tensor, Quotients]:
        """Principal Kirchhoff stresses (N, 3) [Pa] at principal stretches (N, 3), and their divided differences."""
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
        """f_k(sigma) (N, 3); below STRETCH_MIN it goes on as the base, with the slope that this has."""
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
        """Energies (N,) of volume and shear [Pa], and the principal stresses of each."""
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
        base: its analytic law, with numbers as constants: von Mises, Drucker-Prager or viscous flow.
        weights, seed: as of `StructuredElasticity`.

    Raises:
        InputError: a base that has none, weights of other shapes.
    """

    isotropic = True

    def __init__(self, base: Plasticity, weights: Weights | None = None, seed: int = 0):
        super().__init__()
        if type(base) not in (VonMises, DruckerPrager, ViscousFlow):
            raise InputError(_no_base("plasticity", "identity, von_mises, drucker_prager, viscous_flow"))
        self.analytic = base
        self.granular = isinstance(base, DruckerPrager)
        mu, lam = lame(base.values["E"], base.values["nu"])
        # d / m of flow normal to the cone
        self.associated = 2 * mu / (lam + 2 * mu / 3)
        self.friction = base.slope(**base.values) if self.granular else 0.0
        self.threshold = base.values["cohesion"] if self.granular else base.values["yield_stress"] / (2 * mu)
        viscous = isinstance(base, ViscousFlow)
        self.rate = base.values["viscosity"] / (mu * base.values["dt"]) if viscous else 0.0
        constants = self.threshold, self.friction, self.rate, self.associated
        self.kernel = "return", kernels.Constants(int(self.granular), tuple(map(float, constants)))
        self.freeze(_checked(weights, PLASTIC_OUTPUTS, seed))

    def outputs(self, z: Tensor, weights: Weights) -> Tensor:
        """What the network gives (N, k) for invariants z (N, 3)."""
        return network(z, weights)

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        _, sigma = rotation_and_singular_values(F)
        return coaxial_deformation(F, *self.principal(sigma, weights))

    def principal(self, sigma: Tensor, weights: Weights) -> tuple[Tensor, Quotients]:
        """Principal stretches (N, 3) after the return, sigma itself where nothing yields; their divided differences."""
        trace, deviator, norm = hencky_strain(sigma)
        n = self.outputs(invariants(trace / 3 + deviator), weights)
        threshold = _corrected(self.threshold, n[:, :1], COHESION_UNIT)
        friction = _corrected(self.friction, n[:, 1:2], 1.0)
        fluidity = 1 / (1 + _corrected(self.rate, n[:, 2:3], 1.0))
        crush, dilation, compaction = (from_zero(x) / LIMIT for x in (n[:, 3:4], n[:, 4:], -n[:, 4:]))
        dilatancy = dilation * self.associated * friction
        eased = trace * (1 - fluidity * crush)
        if self.granular:
            pressed = eased - 3 * threshold
            limit = -friction * pressed
            torn = pressed > dilatancy * norm
        else:
            limit = threshold + friction * (-eased).clamp(min=0)
            torn = torch.zeros_like(trace, dtype=torch.bool)
        slips = ~torn & (norm > limit)
        share = fluidity / (1 + friction * dilatancy) * (1 - limit / torch.where(slips, norm, 1.0))
        share = torch.where(slips, share, 0.0)  # D / q
        after = eased * (1 - compaction * share) - dilatancy * share * norm
        returned = (after / 3 + deviator * (1 - share)).exp()
        tip = threshold.exp().expand_as(sigma) if self.granular else returned
        changed = torn | slips | (crush > 0)
        y = torch.where(changed, torch.where(torn, tip, returned), sigma)
        scale = torch.where(torn, 0.0, 1 - share).detach()

        def quotients(sigma):
            pairs, values = _Pairs(sigma), y.detach()
            product = values[:, FIRST] * values[:, SECOND]
            quotient = product.clamp(min=0).sqrt() * scale * _sinhc(0.5 * scale * pairs.gap) * pairs.log
            return torch.where(changed, quotient, 1.0), *_sums(values, sigma)

        return y, quotients


def _corrected(constant: float, n: Tensor, unit: float) -> Tensor:
    """constant exp(n), or unit g(n) for a constant that is zero."""
    return constant * n.exp() if constant > 0 else unit * from_zero(n)


def _sums(y: Tensor, sigma: Tensor) -> tuple[Tensor, Tensor]:
    return y[:, FIRST] + y[:, SECOND], sigma[:, FIRST] + sigma[:, SECOND]


def _no_base(part: str, choices: str) -> str:
    return f"a structured {part} corrects an analytic one with numbers as constants: {choices}"


def _checked(weights: Weights | None, outputs: int, seed: int) -> Weights:
    weights = initial_weights(outputs, seed) if weights is None else weights
    found = tuple(tuple(w.shape) for w in weights)
    if found != shapes(outputs):
        raise InputError(f"this structured law has weights of shapes {shapes(outputs)}, not {found}")
    return weights


class StructuredLaw(AdaptableLaw):
    """A corrected elasticity and plasticity; the identity as plasticity has no network."""

    elasticity: StructuredElasticity
    plasticity: StructuredPlasticity | Identity

    def specification(self) -> dict[str, Any]:
        """Form and base, for `structured_law`."""
        base = getattr(self.plasticity, "analytic", self.plasticity)
        return {"form": self.elasticity.form, **specification(self.elasticity.analytic, base)}


def structured_law(
    spec: Mapping[str, Any],
    dt: float | None = None,
    state: Mapping[str, Tensor] | None = None,
    name: str | None = None,
    seed: int = 0,
) -> StructuredLaw:
    """Law around the analytic law of a specification, exactly that law until something is trained.

    Args:
        spec: as for `analytic_law`, with numbers as constants; its key ``form`` ("stretch" if missing) is that of the
            elasticity.
        dt: time step [s], needed by ``viscous_flow``.
        state: tensors of `StructuredLaw.prior_state`; if not given the last layers are zero.
        name: for messages; made of the base's name if not given.
        seed: of the first layers, if ``state`` is not given.

    Raises:
        InputError: what `analytic_law` refuses, a base or a form that there is none of, tensors that do not fit.
    """
    spec = dict(spec)
    form = spec.pop("form", "stretch")
    base = analytic_law(spec, dt)
    weights: dict[str, Weights | None] = {}
    for part in ("elasticity", "plasticity"):
        keys = [f"{part}.{key}" for key in LAYER_KEYS]
        if state is not None and (part == "elasticity" or not isinstance(base.plasticity, Identity)):
            missing = [key for key in keys if key not in state]
            if missing:
                raise InputError(f"structured law: weights {', '.join(missing)} are missing")
            weights[part] = tuple(state[key].float() for key in keys)
    elasticity = StructuredElasticity(base.elasticity, form, weights.get("elasticity"), 2 * seed)
    plasticity = base.plasticity
    if not isinstance(plasticity, Identity):
        plasticity = StructuredPlasticity(plasticity, weights.get("plasticity"), 2 * seed + 1)
    return StructuredLaw(elasticity, plasticity, name or f"structured {base.name}")
