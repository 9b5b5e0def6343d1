"""Analytic elasticities: deformation gradient F -> Kirchhoff stress tau = P F^T [Pa].

Each isotropic law is given by its principal Kirchhoff stresses as a function of the principal stretches sigma, with
Lamé parameters mu, lam and J = sigma_1 sigma_2 sigma_3. All are symmetric, objective and stress-free at F = R.

`Ogden`, `MooneyRivlin` and `FibreReinforced` serve as truths that no simpler law contains: with the same E and nu they
agree with `Hencky` at small strains (the last one in its matrix), and part from it at those of an impact.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neuma_lib.mechanics.catalogue import ELASTICITY, MODULI
from neuma_lib.mechanics.isotropic import Constants, isotropic_stress, lame
from neuma_lib.mechanics.law import Elasticity, Weights

STRETCH_MIN = 0.05
"""Logarithms are of max(sigma, STRETCH_MIN), as in NCLaw, so that a crushed element keeps a finite stress."""

FIBRE_EXPONENT_MAX = 8.0
"""Bound on the exponent of the fibre term, so that a torn element keeps a finite stress; the term is e^8 = 3,000 times
as stiff there as at rest."""


class AnalyticElasticity(Constants, Elasticity):
    """An isotropic elasticity with Young's modulus E [Pa] and Poisson's ratio nu."""

    constants = MODULI

    def principal(
        self, sigma: Tensor, mu: float | Tensor, lam: float | Tensor, **others: float | Tensor
    ) -> Tensor:
        """Principal Kirchhoff stresses (N, 3) [Pa] of the principal stretches (N, 3); ``others``: constants beside E
        and nu."""
        raise NotImplementedError

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        others = self.with_weights(weights)
        mu, lam = lame(others.pop("E"), others.pop("nu"))
        return isotropic_stress(F, lambda sigma: self.principal(sigma, mu, lam, **others))


def _volume_ratio(sigma: Tensor) -> Tensor:
    return (sigma[:, 0] * sigma[:, 1] * sigma[:, 2])[:, None]


def _isochoric_strain(sigma: Tensor) -> tuple[Tensor, Tensor]:
    """Logarithms (N, 3) of the isochoric stretches sigma J^(-1/3), and log J (N, 1)."""
    strain = sigma.clamp(min=STRETCH_MIN).log()
    log_J = strain.sum(1, keepdim=True)
    return strain - log_J / 3, log_J


def _deviator(y: Tensor) -> Tensor:
    return y - y.mean(1, keepdim=True)


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


class Tait(AnalyticElasticity):
    """tau = (K / 7) (J - J^-6) I + 2 mu dev eps, K = lam + 2 mu / 3: a liquid by the equation of state of Tait and Cole
    with the exponent 7, and `Hencky` in shear.

    With the return `fluid_projection` only J counts, as in PAC-NeRF's weakly compressible fluid (Li et al. 2023), whose
    kappa is K / 7. With `viscous_flow` it is a Newtonian fluid: in steady flow tau is 2 viscosity dev D beside the
    pressure, so that PAC-NeRF's mu is twice the viscosity.
    """

    def principal(self, sigma, mu, lam):
        strain, _ = _isochoric_strain(sigma)
        J = _volume_ratio(sigma).clamp(min=STRETCH_MIN)
        return (lam + 2 * mu / 3) / 7 * (J - J**-6) + 2 * mu * strain


class Ogden(AnalyticElasticity):
    """One-term Ogden solid: tau_i = (2 mu / alpha) dev(s_i^alpha) + (lam + 2 mu / 3) log J, s_i = sigma_i J^(-1/3).

    From the energy (2 mu / alpha^2) (sum_i s_i^alpha - 3) + (lam + 2 mu / 3) log(J)^2 / 2 (Ogden 1972). It stiffens
    with strain: at alpha = 12, three times in pure shear to a stretch of 1.16. alpha -> 0 is `Hencky`.
    """

    constants = ELASTICITY["ogden"]

    def principal(self, sigma, mu, lam, alpha):
        strain, log_J = _isochoric_strain(sigma)
        return 2 * mu / alpha * _deviator((alpha * strain).exp()) + (lam + 2 * mu / 3) * log_J


class MooneyRivlin(AnalyticElasticity):
    """tau = mu (1 - q) dev b - mu q dev b^-1 + (lam + 2 mu / 3) log J I with the isochoric b = J^(-2/3) F F^T.

    From the energy C1 (I1 - 3) + C2 (I2 - 3) + (lam + 2 mu / 3) log(J)^2 / 2 of the isochoric invariants, where
    C1 + C2 = mu / 2 and ``q`` = C2 / (C1 + C2): 0 is an isochoric neo-Hookean solid, 1 has the second invariant alone,
    harder to press than to pull. Nearly incompressible with nu near 0.5.
    """

    constants = ELASTICITY["mooney_rivlin"]

    def principal(self, sigma, mu, lam, q):
        strain, log_J = _isochoric_strain(sigma)
        shear = (1 - q) * _deviator((2 * strain).exp()) - q * _deviator((-2 * strain).exp())
        return mu * shear + (lam + 2 * mu / 3) * log_J


class FibreReinforced(Hencky):
    """A `Hencky` matrix with one family of fibres along a (transversely isotropic), and a_F = F a, I4 = |a_F|^2:

    tau = tau_matrix + (H / 2) (I4 - 1) exp(b (I4 - 1)^2) a_F (x) a_F

    from the energy H / (8 b) (exp(b (I4 - 1)^2) - 1) (Holzapfel, Gasser and Ogden 2000; but fibres bear pressure too,
    so that stress is smooth at rest). H = ``fibre_modulus`` [Pa] is what they add to Young's modulus along a at small
    strains, b = ``fibre_exponent`` how they stiffen. a at F = I lies ``elevation`` degrees above the x-z plane, over
    the direction ``azimuth`` degrees from x towards z.
    """

    constants = ELASTICITY["fibre_reinforced"]

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        constants = self.with_weights(weights)
        mu, lam = lame(constants["E"], constants["nu"])
        turn, rise = (
            torch.as_tensor(constants[key], dtype=F.dtype, device=F.device) * (math.pi / 180)
            for key in ("azimuth", "elevation")
        )
        a = torch.stack([rise.cos() * turn.cos(), rise.sin(), rise.cos() * turn.sin()])
        carried = F @ a
        strain = (carried**2).sum(1) - 1
        exponent = (constants["fibre_exponent"] * strain**2).clamp(max=FIBRE_EXPONENT_MAX)
        tension = constants["fibre_modulus"] / 2 * strain * exponent.exp()
        matrix = isotropic_stress(F, lambda sigma: self.principal(sigma, mu, lam))
        return matrix + tension[:, None, None] * carried[:, :, None] * carried[:, None]


ELASTICITIES: dict[str, type[AnalyticElasticity]] = {
    "fixed_corotated": FixedCorotated,
    "stvk": StVK,
    "hencky": Hencky,
    "neo_hookean": NeoHookean,
    "fluid": Fluid,
    "tait": Tait,
    "ogden": Ogden,
    "mooney_rivlin": MooneyRivlin,
    "fibre_reinforced": FibreReinforced,
}
