"""Analytic elasticities: deformation gradient F -> Kirchhoff stress tau = P F^T [Pa].

Each law is given by its principal Kirchhoff stresses as a function of the principal stretches sigma, with Lamé
parameters mu, lam and J = sigma_1 sigma_2 sigma_3. All are symmetric, objective and stress-free at F = R.
"""

from __future__ import annotations

from torch import Tensor

from neuma_lib.mechanics.isotropic import POISSON, YOUNG, Constants, isotropic_stress, lame
from neuma_lib.mechanics.law import Elasticity, Weights

STRETCH_MIN = 0.05
"""Logarithms are of max(sigma, STRETCH_MIN), as in NCLaw, so that a crushed element keeps a finite stress."""


class AnalyticElasticity(Constants, Elasticity):
    """An isotropic elasticity with Young's modulus E [Pa] and Poisson's ratio nu."""

    constants = {"E": YOUNG, "nu": POISSON}

    def principal(self, sigma: Tensor, mu: float | Tensor, lam: float | Tensor) -> Tensor:
        """Principal Kirchhoff stresses (N, 3) [Pa] of the principal stretches (N, 3)."""
        raise NotImplementedError

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        mu, lam = lame(**self.with_weights(weights))
        return isotropic_stress(F, lambda sigma: self.principal(sigma, mu, lam))


def _volume_ratio(sigma: Tensor) -> Tensor:
    return (sigma[:, 0] * sigma[:, 1] * sigma[:, 2])[:, None]


class FixedCorotated(AnalyticElasticity):
    """tau = 2 mu (F - R) F^T + lam J (J - 1) I (Stomakhin et al. 2012)."""

    def principal(self, sigma, mu, lam):
        J = _volume_ratio(sigma)
        return 2 * mu * (sigma - 1) * sigma + lam * J * (J - 1)


class StVK(AnalyticElasticity):
    """Saint Venant-Kirchhoff: tau = F (2 mu E + lam tr(E) I) F^T with Green's strain E = (F^T F - I)/2."""

    def principal(self, sigma, mu, lam):
        strain = 0.5 * (sigma - 1) * (sigma + 1)
        return sigma**2 * (2 * mu * strain + lam * strain.sum(1, keepdim=True))


class Hencky(AnalyticElasticity):
    """tau = U (2 mu eps + lam tr(eps) I) U^T with the logarithmic strain eps = log sigma."""

    def principal(self, sigma, mu, lam):
        strain = sigma.clamp(min=STRETCH_MIN).log()
        return 2 * mu * strain + lam * strain.sum(1, keepdim=True)


class NeoHookean(AnalyticElasticity):
    """Compressible neo-Hookean: tau = mu (F F^T - I) + lam log(J) I."""

    def principal(self, sigma, mu, lam):
        J = _volume_ratio(sigma).clamp(min=STRETCH_MIN**3)
        return mu * (sigma - 1) * (sigma + 1) + lam * J.log()


class Fluid(AnalyticElasticity):
    """Weakly compressible fluid: tau = lam J (J - 1) I."""

    def principal(self, sigma, mu, lam):
        J = _volume_ratio(sigma)
        return (lam * J * (J - 1)).expand_as(sigma)


ELASTICITIES: dict[str, type[AnalyticElasticity]] = {
    "fixed_corotated": FixedCorotated,
    "stvk": StVK,
    "hencky": Hencky,
    "neo_hookean": NeoHookean,
    "fluid": Fluid,
}
