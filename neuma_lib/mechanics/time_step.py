"""Dependence of a law on the time step of the simulation."""

from typing import Literal

from neuma_lib.mechanics.adaptor import AdaptableConstitutive
from neuma_lib.mechanics.isotropic import Constants
from neuma_lib.mechanics.law import Law

StepDependence = Literal["none", "follows", "fixed"]


def step_dependence(law: Law) -> StepDependence:
    """How the return map or the viscous part of a law depends on the time step. An elasticity does not depend on it.

    - "none": the map is an idempotent projection on a yield surface (identity, von Mises, Drucker-Prager).
    - "follows": the step is a constant (viscous flow, a viscous part).
    - "fixed": the map is a network trained with one step. Another step changes the distribution of its trial states
      and the number of returns per second. For a network whose last layer is zero, the base law decides.
    """
    plasticity = law.plasticity
    if isinstance(plasticity, AdaptableConstitutive):
        if bool(plasticity.weights()[-1].any()):
            return "fixed"
        plasticity = getattr(plasticity, "analytic", None)
    if law.viscosity is not None:
        return "follows"
    return "follows" if isinstance(plasticity, Constants) and "dt" in plasticity.constants else "none"
