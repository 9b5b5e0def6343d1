"""Viscous parts of solids: a spring and a dashpot in series, in shear, parallel to the elasticity of a law.

The branch has its own deformation gradient F_b, which follows the same velocity as F and relaxes, so that the law is

    tau = elasticity(F) + 2 modulus dev log V_b,   V_b^2 = F_b F_b^T

with the standard linear solid (Zener) as `Maxwell` and its limit of a fast relaxation as `KelvinVoigt`. A branch is
itself a law (`Viscosity.branch`) of parts with kernels: `ShearSpring` and `plasticity.ViscousFlow`. The simulator adds
its particles at the places of the others (`neuma_lib.sim.branches`).
"""

from typing import ClassVar

from torch import nn

from neuma_lib.mechanics.catalogue import VISCOSITY, viscous_branch
from neuma_lib.mechanics.elasticity import AnalyticElasticity, isochoric_strain
from neuma_lib.mechanics.isotropic import Constants
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.plasticity import ViscousFlow


class ShearSpring(AnalyticElasticity):
    """tau = 2 mu dev eps with the logarithmic strain eps: `Hencky` without bulk modulus."""

    kernel_name = "Hencky"

    @staticmethod
    def coefficients(E, nu):
        mu = E / (2 * (1 + nu))
        return 2 * mu, -2 * mu / 3

    def principal(self, sigma, mu, lam):
        strain, _ = isochoric_strain(sigma)
        return 2 * mu * strain


class Viscosity(Constants, nn.Module):
    """The viscous part of a law. Its weights are those of its branch.

    The shear modulus under a vibration of angular frequency w is mu + G i w T / (1 + i w T) with the shear modulus mu
    of the elasticity, and the modulus G and relaxation time T of the branch.
    """

    part = "viscosity"
    named: "ClassVar[dict[str, type[Viscosity]]]" = {}
    _kept: Law | None = None

    def __init_subclass__(cls, name: str, **options):
        super().__init_subclass__(**options)
        cls.constants, cls.named[name] = VISCOSITY[name], cls

    @property
    def branch(self) -> Law:
        """Spring and dashpot as a law of additional particles, whose F is F_b."""
        if self._kept is not None:
            return self._kept
        modulus, relaxation = viscous_branch(self.values)
        # Of E and nu only the shear modulus matters.
        moduli = {"E": 2 * modulus, "nu": 0.0}
        flow = ViscousFlow(**moduli, viscosity=modulus * relaxation, dt=self.values["dt"])
        law = Law(ShearSpring(**moduli), flow, "viscous branch")
        if not self.weights():
            self.__dict__["_kept"] = law  # recorded graphs are those of its parts
        return law


class KelvinVoigt(Viscosity, name="kelvin_voigt"):
    """tau = elasticity(F) + 2 viscosity dev D with the rate of deformation D, as `Maxwell` with relaxation = dt.

    The viscous stress follows the rate within a time step ``dt`` [s]. A vibration of angular frequency w has the
    damping ratio w viscosity / (2 mu) in shear, which grows with its frequency.
    """


class Maxwell(Viscosity, name="maxwell"):
    """The standard linear solid: a spring of shear modulus ``modulus`` [Pa] that relaxes with a time constant.

    tau = elasticity(F) + 2 modulus dev log V_b, where the logarithmic strain of the branch decays at the rate
    1 / ``relaxation``. A vibration of angular frequency w has the loss factor
    (modulus / mu) w T / (1 + (1 + modulus / mu) w^2 T^2) in shear with T = ``relaxation``. Slow motion has the shear
    modulus mu of the elasticity, fast motion mu + ``modulus``.
    """


VISCOSITIES = Viscosity.named  # viscous parts by name
