"""Analytic plasticities (return maps): trial deformation gradient F_trial -> elastic deformation gradient F.

Each is given by its principal stretches; the directions U, V of F_trial are kept. A state inside the yield
surface is returned unchanged, bit for bit.

`CrushableFoam`, `HerschelBulkley` and `CohesiveDruckerPrager` serve as truths that no simpler return map contains.
Stresses in their formulas are those of `Hencky` elasticity with the same E and nu: tau = 2 mu dev eps + K tr(eps) I
with the logarithmic strain eps and K = lam + 2 mu / 3, p = -tr(tau) / 3, q = sqrt(3/2) |dev tau|.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neuma_lib.mechanics.catalogue import PLASTICITY
from neuma_lib.mechanics.elasticity import STRETCH_MIN
from neuma_lib.mechanics.isotropic import Constants, isotropic_deformation, lame
from neuma_lib.mechanics.law import Plasticity, Weights


class AnalyticPlasticity(Constants, Plasticity):
    """An isotropic return map."""

    def principal(self, sigma: Tensor, **constants: float | Tensor) -> Tensor:
        """Principal stretches (N, 3) after the return; equal to ``sigma`` to the bit where nothing yields."""
        raise NotImplementedError

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        constants = self.with_weights(weights)
        return isotropic_deformation(F, lambda sigma: self.principal(sigma, **constants))


def hencky_strain(sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Trace (N, 1), deviator (N, 3) and the deviator's norm (N, 1) of the logarithmic strain."""
    strain = sigma.clamp(min=STRETCH_MIN).log()
    trace = strain.sum(1, keepdim=True)
    deviator = strain - trace / 3
    tiny = torch.finfo(sigma.dtype).tiny  # keeps the norm differentiable at zero
    return trace, deviator, (deviator**2).sum(1, keepdim=True).clamp(min=tiny).sqrt()


class Identity(Constants, Plasticity):
    """No plasticity: F = F_trial."""

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        return F.clone()

    def vjp(self, F, weights, grad_out, cache=None, grad_F=None, grad_weights=None):
        result = grad_out.clone() if grad_F is None else grad_F.copy_(grad_out)
        return result, () if grad_weights is None else grad_weights


class VonMises(AnalyticPlasticity):
    """Yield where |dev eps| > yield_stress / (2 mu), eps the logarithmic strain; return along dev eps to the surface.

    With Hencky elasticity this bounds the norm of the deviatoric Kirchhoff stress by ``yield_stress`` [Pa].
    """

    constants = PLASTICITY["von_mises"]

    def principal(self, sigma, E, nu, yield_stress):
        mu, _ = lame(E, nu)
        trace, deviator, norm = hencky_strain(sigma)
        limit = yield_stress / (2 * mu)
        returned = (trace / 3 + deviator * (limit / norm)).exp()
        return torch.where(norm > limit, returned, sigma)


class DruckerPrager(AnalyticPlasticity):
    """Granular flow (Klar et al. 2016): shear is bounded by friction times pressure; no tension.

    ``friction_angle`` in degrees; ``cohesion`` is the volumetric log strain per axis that is borne in tension.
    """

    constants = PLASTICITY["drucker_prager"]

    @staticmethod
    def slope(E, nu, friction_angle, **_) -> float | Tensor:
        """Slope of the cone in Hencky strain: norm of the deviator at yield over the negative trace."""
        mu, lam = lame(E, nu)
        if isinstance(friction_angle, Tensor):
            sine = torch.sin(friction_angle * (math.pi / 180))
        else:
            sine = math.sin(math.radians(friction_angle))
        alpha = math.sqrt(2 / 3) * 2 * sine / (3 - sine)
        return (3 * lam + 2 * mu) / (2 * mu) * alpha

    def principal(self, sigma, E, nu, friction_angle, cohesion):
        trace, deviator, norm = hencky_strain(sigma)
        pressed = trace - 3 * cohesion
        excess = norm + self.slope(E, nu, friction_angle) * pressed
        sheared = (trace / 3 + deviator * (1 - excess / norm)).exp()
        apex = torch.full_like(sigma, 1.0) * (
            cohesion.exp() if isinstance(cohesion, Tensor) else math.exp(cohesion)
        )
        returned = torch.where(pressed > 0, apex, sheared)
        return torch.where((pressed > 0) | (excess > 0), returned, sigma)


class FluidProjection(AnalyticPlasticity):
    """A fluid forgets shear: F = J^(1/3) R. Same stress as the customary J^(1/3) I, but objective."""

    def principal(self, sigma):
        J = (sigma[:, 0] * sigma[:, 1] * sigma[:, 2])[:, None]
        return J.clamp(min=STRETCH_MIN**3).pow(1 / 3).expand_as(sigma)


class ViscousFlow(AnalyticPlasticity):
    """Viscous relaxation of the deviatoric logarithmic strain, by one implicit step of length ``dt`` [s].

    The strain beyond the yield stress decays at the rate mu / viscosity; with Hencky elasticity the shear stress of a
    steady flow is then exactly viscosity times shear rate (a Bingham fluid if ``yield_stress`` > 0).
    """

    constants = PLASTICITY["viscous_flow"]

    def principal(self, sigma, E, nu, viscosity, dt, yield_stress):
        mu, _ = lame(E, nu)
        trace, deviator, norm = hencky_strain(sigma)
        limit = yield_stress / (2 * mu)
        relaxed = limit + (norm - limit) / (1 + mu * dt / viscosity)
        returned = (trace / 3 + deviator * (relaxed / norm)).exp()
        return torch.where(norm > limit, returned, sigma)


class CrushableFoam(AnalyticPlasticity):
    """Compactable foam: yield outside an ellipse in (p, q), from -``tension`` to ``crush`` [Pa] along p, whose
    half axis in q is ``slope`` times that in p; radial return.

    The elastic strain shrinks towards zero along itself, eps = r eps_trial: pressure compacts the foam for good, with a
    plastic Poisson's ratio equal to the elastic one (not associated; Deshpande and Fleck 2000 have an associated
    ellipse). Every return dissipates.

    Hardening is by rate: the strain outside decays to the ellipse in ``relaxation`` [s] (Duvaut and Lions), as where
    gas has to leave the cells, by one implicit step of length ``dt``. Compacted at the rate d the pressure rises to
    crush + K d relaxation. Hardening by compaction itself is not possible here: the state is the elastic F alone,
    whose volume says the pressure and nothing of the volume that was lost.
    """

    constants = PLASTICITY["crushable_foam"]

    def principal(self, sigma, E, nu, crush, tension, slope, dt, relaxation):
        mu, lam = lame(E, nu)
        trace, deviator, norm = hencky_strain(sigma)
        centre, half = (crush - tension) / 2, (crush + tension) / 2
        p, q = -(lam + 2 * mu / 3) * trace / half, math.sqrt(6) * mu * norm / (slope * half)
        # the ray r (p, q) meets the ellipse where a r^2 - 2 b r - c = 0
        a, b = p**2 + q**2, p * (centre / half)
        c = 1 - (centre / half) ** 2
        outside = a - 2 * b - c > 0
        a = torch.where(outside, a, torch.ones_like(a))
        r = (b + (b**2 + a * c).sqrt()) / a
        r = r + (1 - r) * (relaxation / (relaxation + dt))
        returned = (r * (trace / 3 + deviator)).exp()
        return torch.where(outside, returned, sigma)


class HerschelBulkley(AnalyticPlasticity):
    """A paste that flows beyond its yield stress, thinner (``exponent`` m < 1) or thicker (m > 1) the faster it is.

    |dev tau| = yield_stress + sqrt(2) k g^m with the shear rate g = sqrt(2) |D|: a steady simple shear of rate g has
    the shear stress yield_stress / sqrt(2) + k g^m, k = ``consistency``. m = 1 is `ViscousFlow`. One implicit step of
    length ``dt`` [s]; its equation is solved by Newton's method, and differentiated as an implicit function.
    """

    constants = PLASTICITY["herschel_bulkley"]

    def principal(self, sigma, E, nu, consistency, exponent, yield_stress, dt):
        mu, _ = lame(E, nu)
        trace, deviator, norm = hencky_strain(sigma)
        limit = yield_stress / (2 * mu)
        # in y = |dev eps| - limit: y + dt D = y_trial with D = (sqrt(2) mu y / k)^(1/m) / sqrt(2)
        power = 1 / exponent
        rate = dt / math.sqrt(2) * (math.sqrt(2) * mu / consistency) ** power
        excess = (norm - limit).clamp(min=torch.finfo(sigma.dtype).eps ** 2)
        relaxed = limit + _positive_root(rate, power, excess)
        returned = (trace / 3 + deviator * (relaxed / norm)).exp()
        return torch.where(norm > limit, returned, sigma)


NEWTON_STEPS = 8
"""Of `_positive_root`: enough for float64 at any power that `HerschelBulkley` admits, as a test shows."""


def _positive_root(rate: float | Tensor, power: float | Tensor, total: Tensor) -> Tensor:
    """y > 0 of y + rate y^power = total > 0, shape of ``total``; differentiable in all three.

    In u = log y the logarithm of the left side is convex and increasing, so that Newton's method falls to the root from
    a start above it. Only its last step is differentiated: the derivative of the implicit function.
    """
    log_rate, log_total = torch.as_tensor(rate, dtype=total.dtype, device=total.device).log(), total.log()

    def newton_step(u: Tensor) -> Tensor:
        share = torch.sigmoid(log_rate + (power - 1) * u)  # of the second term in the sum
        slope = 1 + (power - 1) * share
        return u - (torch.logaddexp(u, log_rate + power * u) - log_total) / slope.detach()

    with torch.no_grad():
        u = torch.minimum(log_total, (log_total - log_rate) / power)
        for _ in range(NEWTON_STEPS):
            u = newton_step(u)
    return newton_step(u).exp()


class CohesiveDruckerPrager(AnalyticPlasticity):
    """Damp, dense grains: friction, ``cohesion`` c [Pa], and dilatancy (a volume that grows in shear).

    q <= 6 (c cos phi + p sin phi) / (3 - sin phi), the compressive cone of Mohr and Coulomb for the angle phi =
    ``friction_angle``; plastic strain along dev tau / |dev tau| + alpha(psi) I with ``dilation_angle`` psi <= phi, to
    the apex where that would turn the deviator round. Both angles in degrees, alpha(x) = sqrt(2/3) 2 sin x / (3 - sin
    x). Every return dissipates. `DruckerPrager` is c = psi = 0 but for its apex, which takes all states of tension.
    """

    constants = PLASTICITY["cohesive_drucker_prager"]

    def principal(self, sigma, E, nu, friction_angle, cohesion, dilation_angle):
        mu, lam = lame(E, nu)
        bulk = lam + 2 * mu / 3

        def sine_and_alpha(degrees):
            sine = torch.sin(
                torch.as_tensor(degrees, dtype=sigma.dtype, device=sigma.device) * (math.pi / 180)
            )
            return sine, math.sqrt(2 / 3) * 2 * sine / (3 - sine)

        sine, alpha = sine_and_alpha(friction_angle)
        _, beta = sine_and_alpha(dilation_angle)
        strength = math.sqrt(2 / 3) * 6 * cohesion * (1 - sine**2).sqrt() / (3 - sine)
        trace, deviator, norm = hencky_strain(sigma)
        excess = 2 * mu * norm + 3 * bulk * alpha * trace - strength
        flow = excess / (2 * mu + 9 * bulk * alpha * beta)
        kept = flow.clamp(min=0).minimum(norm)  # what the branches not taken need to stay finite
        sheared = (trace / 3 - beta * kept + deviator * (1 - kept / norm)).exp()
        apex = (strength / (9 * bulk * alpha)).exp() * torch.ones_like(sigma)
        return torch.where(excess > 0, torch.where(flow < norm, sheared, apex), sigma)


PLASTICITIES: dict[str, type[Plasticity]] = {
    "identity": Identity,
    "von_mises": VonMises,
    "drucker_prager": DruckerPrager,
    "fluid_projection": FluidProjection,
    "viscous_flow": ViscousFlow,
    "crushable_foam": CrushableFoam,
    "herschel_bulkley": HerschelBulkley,
    "cohesive_drucker_prager": CohesiveDruckerPrager,
}
