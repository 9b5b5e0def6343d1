"""Analytic plasticities (return maps): trial deformation gradient F_trial -> elastic deformation gradient F.

Each is given by its principal stretches; the directions U, V of F_trial are kept. A state inside the yield
surface is returned unchanged, bit for bit.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neuma_lib.mechanics.elasticity import STRETCH_MIN
from neuma_lib.mechanics.isotropic import POISSON, YOUNG, Constant, Constants, isotropic_deformation, lame
from neuma_lib.mechanics.law import Plasticity, Weights


class AnalyticPlasticity(Constants, Plasticity):
    """An isotropic return map."""

    def principal(self, sigma: Tensor, **constants: float | Tensor) -> Tensor:
        """Principal stretches (N, 3) after the return; equal to ``sigma`` to the bit where nothing yields."""
        raise NotImplementedError

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        constants = self.with_weights(weights)
        return isotropic_deformation(F, lambda sigma: self.principal(sigma, **constants))


def _hencky_strain(sigma: Tensor) -> tuple[Tensor, Tensor, Tensor]:
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

    constants = {"E": YOUNG, "nu": POISSON, "yield_stress": Constant("Pa", 0.0, closed=True)}

    def principal(self, sigma, E, nu, yield_stress):
        mu, _ = lame(E, nu)
        trace, deviator, norm = _hencky_strain(sigma)
        limit = yield_stress / (2 * mu)
        returned = (trace / 3 + deviator * (limit / norm)).exp()
        return torch.where(norm > limit, returned, sigma)


class DruckerPrager(AnalyticPlasticity):
    """Granular flow (Klar et al. 2016): shear is bounded by friction times pressure; no tension.

    ``friction_angle`` in degrees; ``cohesion`` is the volumetric log strain per axis that is borne in tension.
    """

    constants = {
        "E": YOUNG,
        "nu": POISSON,
        "friction_angle": Constant("degrees", 0.0, 90.0),
        "cohesion": Constant("1", 0.0, closed=True, default=0.0),
    }

    def principal(self, sigma, E, nu, friction_angle, cohesion):
        mu, lam = lame(E, nu)
        if isinstance(friction_angle, Tensor):
            sine = torch.sin(friction_angle * (math.pi / 180))
        else:
            sine = math.sin(math.radians(friction_angle))
        alpha = math.sqrt(2 / 3) * 2 * sine / (3 - sine)
        trace, deviator, norm = _hencky_strain(sigma)
        pressed = trace - 3 * cohesion
        excess = norm + (3 * lam + 2 * mu) / (2 * mu) * alpha * pressed
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

    constants = {
        "E": YOUNG,
        "nu": POISSON,
        "viscosity": Constant("Pa s", 0.0),
        "dt": Constant("s", 0.0),
        "yield_stress": Constant("Pa", 0.0, closed=True, default=0.0),
    }

    def principal(self, sigma, E, nu, viscosity, dt, yield_stress):
        mu, _ = lame(E, nu)
        trace, deviator, norm = _hencky_strain(sigma)
        limit = yield_stress / (2 * mu)
        relaxed = limit + (norm - limit) / (1 + mu * dt / viscosity)
        returned = (trace / 3 + deviator * (relaxed / norm)).exp()
        return torch.where(norm > limit, returned, sigma)


PLASTICITIES: dict[str, type[Plasticity]] = {
    "identity": Identity,
    "von_mises": VonMises,
    "drucker_prager": DruckerPrager,
    "fluid_projection": FluidProjection,
    "viscous_flow": ViscousFlow,
}
