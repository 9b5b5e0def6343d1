"""Analytic plasticities (return maps): trial deformation gradient F_trial -> elastic deformation gradient F.

Each is given by its principal stretches and keeps the directions U, V of F_trial. A state inside the yield surface is
returned bit-identically.

`CrushableFoam`, `HerschelBulkley` and `CohesiveDruckerPrager` serve as ground truth outside the candidate families.
Their formulas use the stresses of `Hencky` elasticity with the same E and nu: tau = 2 mu dev eps + K tr(eps) I with
the logarithmic strain eps and K = lam + 2 mu / 3, p = -tr(tau) / 3, q = sqrt(3/2) |dev tau|.
"""

import math

import torch
from torch import Tensor

from neuma_lib.mechanics.analytic_kernels import STRETCH_MIN
from neuma_lib.mechanics.catalogue import PLASTICITY, lame
from neuma_lib.mechanics.isotropic import Constants, isotropic_deformation
from neuma_lib.mechanics.law import Plasticity, Weights


class AnalyticPlasticity(Constants, Plasticity):
    """An isotropic return map."""

    def principal(self, sigma: Tensor, **constants: float | Tensor) -> Tensor:
        """Principal stretches (N, 3) after the return, bit-identical to ``sigma`` where nothing yields."""
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


class Identity(Constants, Plasticity, name="identity"):
    """No plasticity: F = F_trial."""

    capturable = True
    native = True
    identity = True

    @staticmethod
    def coefficients():
        return ()

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        return F.clone()

    def evaluate(self, F, weights, out=None):
        return F.detach().clone() if out is None else out.copy_(F.detach())

    def vjp(self, F, weights, grad_out, cache=None, grad_F=None, grad_weights=None):
        result = grad_out.clone() if grad_F is None else grad_F.copy_(grad_out)
        return result, () if grad_weights is None else grad_weights


class VonMises(AnalyticPlasticity, name="von_mises"):
    """Yield at |dev eps| > yield_stress / (2 mu), eps the logarithmic strain, with return along dev eps to the surface.

    With Hencky elasticity this bounds the norm of the deviatoric Kirchhoff stress by ``yield_stress`` [Pa].
    """

    constants = PLASTICITY["von_mises"]

    @staticmethod
    def coefficients(E, nu, yield_stress):
        mu, _ = lame(E, nu)
        return yield_stress / (2 * mu), 0.0

    def principal(self, sigma, E, nu, yield_stress):
        mu, _ = lame(E, nu)
        trace, deviator, norm = hencky_strain(sigma)
        limit = yield_stress / (2 * mu)
        returned = (trace / 3 + deviator * (limit / norm)).exp()
        return torch.where(norm > limit, returned, sigma)


class DruckerPrager(AnalyticPlasticity, name="drucker_prager"):
    """Granular flow (Klar et al. 2016): shear is bounded by friction times pressure, without tension.

    ``friction_angle`` in degrees; ``cohesion`` is the largest tensile logarithmic strain per axis.
    """

    constants = PLASTICITY["drucker_prager"]

    @staticmethod
    def slope(E, nu, friction_angle, **_) -> float | Tensor:
        """Slope of the cone in Hencky strain: norm of the deviator at yield divided by the negative trace."""
        mu, lam = lame(E, nu)
        if isinstance(friction_angle, Tensor):
            sine = torch.sin(friction_angle * (math.pi / 180))
        else:
            sine = math.sin(math.radians(friction_angle))
        alpha = math.sqrt(2 / 3) * 2 * sine / (3 - sine)
        return (3 * lam + 2 * mu) / (2 * mu) * alpha

    @staticmethod
    def coefficients(E, nu, friction_angle, cohesion):
        return DruckerPrager.slope(E, nu, friction_angle), cohesion

    def principal(self, sigma, E, nu, friction_angle, cohesion):
        trace, deviator, norm = hencky_strain(sigma)
        shifted = trace - 3 * cohesion  # trace relative to the apex
        excess = norm + self.slope(E, nu, friction_angle) * shifted
        sheared = (trace / 3 + deviator * (1 - excess / norm)).exp()
        apex = torch.full_like(sigma, 1.0) * (
            cohesion.exp() if isinstance(cohesion, Tensor) else math.exp(cohesion)
        )
        returned = torch.where(shifted > 0, apex, sheared)
        return torch.where((shifted > 0) | (excess > 0), returned, sigma)


class FluidProjection(AnalyticPlasticity, name="fluid_projection"):
    """Removes all shear of a fluid: F = J^(1/3) R. Same stress as the usual J^(1/3) I, but objective."""

    @staticmethod
    def coefficients():
        return ()

    def principal(self, sigma):
        J = (sigma[:, 0] * sigma[:, 1] * sigma[:, 2])[:, None]
        return J.clamp(min=STRETCH_MIN**3).pow(1 / 3).expand_as(sigma)


class ViscousFlow(AnalyticPlasticity, name="viscous_flow"):
    """Viscous relaxation of the deviatoric logarithmic strain, by one implicit step of length ``dt`` [s].

    The strain beyond the yield stress decays at the rate mu / viscosity. With Hencky elasticity the shear stress of a
    steady flow is exactly viscosity times shear rate (a Bingham fluid if ``yield_stress`` > 0).
    """

    constants = PLASTICITY["viscous_flow"]

    @staticmethod
    def coefficients(E, nu, viscosity, dt, yield_stress):
        mu, _ = lame(E, nu)
        return yield_stress / (2 * mu), 1 / (1 + mu * dt / viscosity)

    def principal(self, sigma, E, nu, viscosity, dt, yield_stress):
        mu, _ = lame(E, nu)
        trace, deviator, norm = hencky_strain(sigma)
        limit = yield_stress / (2 * mu)
        relaxed = limit + (norm - limit) / (1 + mu * dt / viscosity)
        returned = (trace / 3 + deviator * (relaxed / norm)).exp()
        return torch.where(norm > limit, returned, sigma)


class CrushableFoam(AnalyticPlasticity, name="crushable_foam"):
    """Compactable foam: yield outside an ellipse in (p, q) that extends from -``tension`` to ``crush`` [Pa] along p
    and has a half axis in q of ``slope`` times that in p, with radial return.

    The elastic strain is scaled, eps = r eps_trial, so that pressure compacts the foam permanently with a plastic
    Poisson's ratio equal to the elastic one (non-associated; the ellipse of Deshpande and Fleck 2000 is associated).
    Every return dissipates.

    Hardening is viscous: the strain outside decays to the ellipse with the time constant ``relaxation`` [s] (Duvaut
    and Lions), in one implicit step of length ``dt``. At the compaction rate d the pressure rises to crush + K d
    relaxation. Hardening by compaction is not possible because the elastic F contains no plastic volume.
    """

    constants = PLASTICITY["crushable_foam"]

    @staticmethod
    def coefficients(E, nu, crush, tension, slope, dt, relaxation):
        mu, lam = lame(E, nu)
        half, centre = (crush + tension) / 2, (crush - tension) / (crush + tension)
        rounding = 4 * crush * tension / (crush + tension) ** 2  # 1 - centre^2 without cancellation
        return (
            (lam + 2 * mu / 3) / half,
            math.sqrt(6) * mu / (slope * half),
            centre,
            rounding,
            relaxation / (relaxation + dt),
        )

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


class HerschelBulkley(AnalyticPlasticity, name="herschel_bulkley"):
    """A yield-stress fluid that is shear-thinning (``exponent`` m < 1) or shear-thickening (m > 1).

    |dev tau| = yield_stress + sqrt(2) k g^m with the shear rate g = sqrt(2) |D| and k = ``consistency``. A steady
    simple shear of rate g has the shear stress yield_stress / sqrt(2) + k g^m. m = 1 is `ViscousFlow`. One implicit
    step of length ``dt`` [s] is solved by Newton's method and differentiated as an implicit function.
    """

    constants = PLASTICITY["herschel_bulkley"]

    @staticmethod
    def coefficients(E, nu, consistency, exponent, yield_stress, dt):
        mu, _ = lame(E, nu)
        log_rate = (dt / math.sqrt(2)).log() + (math.sqrt(2) * mu / consistency).log() / exponent
        return yield_stress / (2 * mu), log_rate, 1 / exponent

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
"""Iterations of `_positive_root`, sufficient in float64 for every exponent that `HerschelBulkley` admits."""


def _positive_root(rate: float | Tensor, power: float | Tensor, total: Tensor) -> Tensor:
    """y > 0 of y + rate y^power = total > 0, shape of ``total``; differentiable in all three.

    In u = log y the logarithm of the left side is convex and increasing, so that Newton's method decreases to the root
    from a start above it. Differentiating only the last step gives the derivative of the implicit function.
    """
    log_rate, log_total = torch.as_tensor(rate, dtype=total.dtype, device=total.device).log(), total.log()

    def newton_step(u: Tensor) -> Tensor:
        share = torch.sigmoid(log_rate + (power - 1) * u)  # share of the second term
        slope = 1 + (power - 1) * share
        return u - (torch.logaddexp(u, log_rate + power * u) - log_total) / slope.detach()

    with torch.no_grad():
        u = torch.minimum(log_total, (log_total - log_rate) / power)
        for _ in range(NEWTON_STEPS):
            u = newton_step(u)
    return newton_step(u).exp()


def _sine_and_alpha(degrees: Tensor) -> tuple[Tensor, Tensor]:
    """sin x and alpha(x) of an angle, see `CohesiveDruckerPrager`."""
    sine = torch.sin(degrees * (math.pi / 180))
    return sine, math.sqrt(2 / 3) * 2 * sine / (3 - sine)


class CohesiveDruckerPrager(AnalyticPlasticity, name="cohesive_drucker_prager"):
    """Damp, dense granular material with friction, ``cohesion`` c [Pa] and dilatancy.

    q <= 6 (c cos phi + p sin phi) / (3 - sin phi), the compressive Mohr-Coulomb cone for phi = ``friction_angle``.
    Plastic strain is along dev tau / |dev tau| + alpha(psi) I with ``dilation_angle`` psi <= phi, or to the apex where
    that would reverse the deviator. Both angles in degrees, alpha(x) = sqrt(2/3) 2 sin x / (3 - sin x). Every return
    dissipates. `DruckerPrager` is c = psi = 0, except that it returns all tensile states to its apex.
    """

    constants = PLASTICITY["cohesive_drucker_prager"]

    @staticmethod
    def coefficients(E, nu, friction_angle, cohesion, dilation_angle):
        mu, lam = lame(E, nu)
        (sine, alpha), (_, beta) = _sine_and_alpha(friction_angle), _sine_and_alpha(dilation_angle)
        strength = math.sqrt(2 / 3) * 6 * cohesion * (1 - sine**2).sqrt() / (3 - sine)
        return (3 * lam + 2 * mu) / (2 * mu) * alpha, strength / (2 * mu), beta

    def principal(self, sigma, E, nu, friction_angle, cohesion, dilation_angle):
        mu, lam = lame(E, nu)
        bulk = lam + 2 * mu / 3

        sine, alpha = _sine_and_alpha(torch.as_tensor(friction_angle).to(sigma))
        _, beta = _sine_and_alpha(torch.as_tensor(dilation_angle).to(sigma))
        strength = math.sqrt(2 / 3) * 6 * cohesion * (1 - sine**2).sqrt() / (3 - sine)
        trace, deviator, norm = hencky_strain(sigma)
        excess = 2 * mu * norm + 3 * bulk * alpha * trace - strength
        flow = excess / (2 * mu + 9 * bulk * alpha * beta)
        bounded = flow.clamp(min=0).minimum(norm)  # keeps the branches that are not selected finite
        sheared = (trace / 3 - beta * bounded + deviator * (1 - bounded / norm)).exp()
        apex = (strength / (9 * bulk * alpha)).exp() * torch.ones_like(sigma)
        return torch.where(excess > 0, torch.where(flow < norm, sheared, apex), sigma)


PLASTICITIES = Plasticity.named
"""Return maps by name."""
