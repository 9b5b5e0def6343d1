"""Analytic elasticities: deformation gradient F -> Kirchhoff stress tau = P F^T [Pa].

Each isotropic law is given by its principal Kirchhoff stresses as a function of the principal stretches sigma, with
Lamé parameters mu, lam and J = sigma_1 sigma_2 sigma_3. All are symmetric, objective and stress-free at F = R.

`Ogden`, `MooneyRivlin` and `FibreReinforced` serve as ground truth outside the candidate families. With equal E and nu
they agree with `Hencky` at small strains (`FibreReinforced` in its matrix) and deviate at the strains of an impact.
"""

import math

import torch
from torch import Tensor

from neuma_lib.mechanics.analytic_kernels import FIBRE_EXPONENT_MAX, STRETCH_MIN
from neuma_lib.mechanics.catalogue import ELASTICITY, MODULI, lame
from neuma_lib.mechanics.isotropic import Constants, isotropic_stress
from neuma_lib.mechanics.law import Elasticity, Weights


class AnalyticElasticity(Constants, Elasticity):
    """An isotropic elasticity with Young's modulus E [Pa] and Poisson's ratio nu."""

    constants = MODULI

    def principal(
        self, sigma: Tensor, mu: float | Tensor, lam: float | Tensor, **others: float | Tensor
    ) -> Tensor:
        """Principal Kirchhoff stresses (N, 3) [Pa] of the principal stretches (N, 3), with constants other than E and
        nu in ``others``."""
        raise NotImplementedError

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        others = self.with_weights(weights)
        mu, lam = lame(others.pop("E"), others.pop("nu"))
        return isotropic_stress(F, lambda sigma: self.principal(sigma, mu, lam, **others))


def _volume_ratio(sigma: Tensor) -> Tensor:
    return (sigma[:, 0] * sigma[:, 1] * sigma[:, 2])[:, None]


def isochoric_strain(sigma: Tensor) -> tuple[Tensor, Tensor]:
    """Logarithms (N, 3) of the isochoric stretches sigma J^(-1/3), and log J (N, 1)."""
    strain = sigma.clamp(min=STRETCH_MIN).log()
    log_J = strain.sum(1, keepdim=True)
    return strain - log_J / 3, log_J


def _deviator(y: Tensor) -> Tensor:
    return y - y.mean(1, keepdim=True)


class FixedCorotated(AnalyticElasticity, name="fixed_corotated"):
    """tau = 2 mu (F - R) F^T + lam J (J - 1) I (Stomakhin et al. 2012)."""

    @staticmethod
    def coefficients(E, nu):
        mu, lam = lame(E, nu)
        return 2 * mu, lam

    def principal(self, sigma, mu, lam):
        J = _volume_ratio(sigma)
        return 2 * mu * (sigma - 1) * sigma + lam * J * (J - 1)


class StVK(AnalyticElasticity, name="stvk"):
    """Saint Venant-Kirchhoff: tau = F (2 mu E + lam tr(E) I) F^T with Green's strain E = (F^T F - I)/2."""

    @staticmethod
    def coefficients(E, nu):
        mu, lam = lame(E, nu)
        return 2 * mu, lam

    def principal(self, sigma, mu, lam):
        strain = 0.5 * (sigma - 1) * (sigma + 1)
        return sigma**2 * (2 * mu * strain + lam * strain.sum(1, keepdim=True))


class Hencky(AnalyticElasticity, name="hencky"):
    """tau = U (2 mu eps + lam tr(eps) I) U^T with the logarithmic strain eps = log sigma."""

    @staticmethod
    def coefficients(E, nu):
        mu, lam = lame(E, nu)
        return 2 * mu, lam

    def principal(self, sigma, mu, lam):
        strain = sigma.clamp(min=STRETCH_MIN).log()
        return 2 * mu * strain + lam * strain.sum(1, keepdim=True)


class NeoHookean(AnalyticElasticity, name="neo_hookean"):
    """Compressible neo-Hookean: tau = mu (F F^T - I) + lam log(J) I."""

    @staticmethod
    def coefficients(E, nu):
        return lame(E, nu)

    def principal(self, sigma, mu, lam):
        J = _volume_ratio(sigma).clamp(min=STRETCH_MIN**3)
        return mu * (sigma - 1) * (sigma + 1) + lam * J.log()


class Fluid(AnalyticElasticity, name="fluid"):
    """Weakly compressible fluid: tau = lam J (J - 1) I."""

    @staticmethod
    def coefficients(E, nu):
        return lame(E, nu)[1:]

    def principal(self, sigma, mu, lam):
        J = _volume_ratio(sigma)
        return (lam * J * (J - 1)).expand_as(sigma)


class Tait(AnalyticElasticity, name="tait"):
    """tau = (K / 7) (J - J^-6) I + 2 mu dev eps, K = lam + 2 mu / 3: the Tait-Cole equation of state of a liquid with
    exponent 7, and `Hencky` in shear.

    With `fluid_projection` the stress depends on J only, as in PAC-NeRF's weakly compressible fluid (Li et al. 2023),
    whose kappa is K / 7. With `viscous_flow` it is a Newtonian fluid: dev tau = 2 viscosity dev D in steady flow, so
    that PAC-NeRF's mu is twice the viscosity.
    """

    @staticmethod
    def coefficients(E, nu):
        mu, lam = lame(E, nu)
        return 2 * mu, (lam + 2 * mu / 3) / 7

    def principal(self, sigma, mu, lam):
        strain, _ = isochoric_strain(sigma)
        J = _volume_ratio(sigma).clamp(min=STRETCH_MIN)
        return (lam + 2 * mu / 3) / 7 * (J - J**-6) + 2 * mu * strain


class Ogden(AnalyticElasticity, name="ogden"):
    """One-term Ogden solid: tau_i = (2 mu / alpha) dev(s_i^alpha) + (lam + 2 mu / 3) log J, s_i = sigma_i J^(-1/3).

    Energy (2 mu / alpha^2) (sum_i s_i^alpha - 3) + (lam + 2 mu / 3) log(J)^2 / 2 (Ogden 1972). The solid stiffens with
    strain, for alpha = 12 by a factor of three in pure shear to a stretch of 1.16. alpha -> 0 is `Hencky`.
    """

    constants = ELASTICITY["ogden"]

    @staticmethod
    def coefficients(E, nu, alpha):
        mu, lam = lame(E, nu)
        return 2 * mu / alpha, alpha, lam + 2 * mu / 3

    def principal(self, sigma, mu, lam, alpha):
        strain, log_J = isochoric_strain(sigma)
        return 2 * mu / alpha * _deviator((alpha * strain).exp()) + (lam + 2 * mu / 3) * log_J


class MooneyRivlin(AnalyticElasticity, name="mooney_rivlin"):
    """tau = mu (1 - q) dev b - mu q dev b^-1 + (lam + 2 mu / 3) log J I with the isochoric b = J^(-2/3) F F^T.

    Energy C1 (I1 - 3) + C2 (I2 - 3) + (lam + 2 mu / 3) log(J)^2 / 2 of the isochoric invariants, with C1 + C2 = mu / 2
    and ``q`` = C2 / (C1 + C2). q = 0 is an isochoric neo-Hookean solid. q = 1 has the second invariant only and is
    stiffer in compression than in tension. Nearly incompressible with nu near 0.5.
    """

    constants = ELASTICITY["mooney_rivlin"]

    @staticmethod
    def coefficients(E, nu, q):
        mu, lam = lame(E, nu)
        return mu * (1 - q), mu * q, lam + 2 * mu / 3

    def principal(self, sigma, mu, lam, q):
        strain, log_J = isochoric_strain(sigma)
        shear = (1 - q) * _deviator((2 * strain).exp()) - q * _deviator((-2 * strain).exp())
        return mu * shear + (lam + 2 * mu / 3) * log_J


def direction(azimuth: Tensor, elevation: Tensor) -> Tensor:
    """Unit vector (3,) of two angles in degrees."""
    azimuth, elevation = azimuth * (math.pi / 180), elevation * (math.pi / 180)
    return torch.stack([elevation.cos() * azimuth.cos(), elevation.sin(), elevation.cos() * azimuth.sin()])


class FibreReinforced(Hencky, name="fibre_reinforced"):
    """A `Hencky` matrix with one family of fibres along a (transversely isotropic), with a_F = F a and I4 = |a_F|^2:

    tau = tau_matrix + (H / 2) (I4 - 1) exp(b (I4 - 1)^2) a_F (x) a_F

    Energy H / (8 b) (exp(b (I4 - 1)^2) - 1) (Holzapfel, Gasser and Ogden 2000, but with fibres that bear compression,
    so that the stress is smooth at rest). H = ``fibre_modulus`` [Pa] adds to Young's modulus along a at small strains,
    b = ``fibre_exponent`` controls stiffening. At F = I, a has ``elevation`` degrees above the x-z plane and
    ``azimuth`` degrees from x towards z.
    """

    constants = ELASTICITY["fibre_reinforced"]

    @staticmethod
    def coefficients(E, nu, fibre_modulus, fibre_exponent, azimuth, elevation):
        along = direction(azimuth, elevation).unbind()
        return *Hencky.coefficients(E, nu), fibre_modulus / 2, fibre_exponent, *along

    def response(self, F: Tensor, weights: Weights) -> Tensor:
        constants = self.with_weights(weights)
        mu, lam = lame(constants["E"], constants["nu"])
        a_F = F @ direction(
            *(
                torch.as_tensor(constants[key], dtype=F.dtype, device=F.device)
                for key in ("azimuth", "elevation")
            )
        )
        strain = (a_F**2).sum(1) - 1
        exponent = (constants["fibre_exponent"] * strain**2).clamp(max=FIBRE_EXPONENT_MAX)
        tension = constants["fibre_modulus"] / 2 * strain * exponent.exp()
        matrix = isotropic_stress(F, lambda sigma: self.principal(sigma, mu, lam))
        return matrix + tension[:, None, None] * a_F[:, :, None] * a_F[:, None]


ELASTICITIES = Elasticity.named
"""Elasticities by name."""
