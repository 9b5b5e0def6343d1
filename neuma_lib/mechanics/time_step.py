"""What a law's time step has to do with what it says."""

from __future__ import annotations

from typing import Literal

from neuma_lib.mechanics.adaptor import AdaptableConstitutive
from neuma_lib.mechanics.isotropic import Constants
from neuma_lib.mechanics.law import Law

StepDependence = Literal["none", "follows", "fixed"]


def step_dependence(law: Law) -> StepDependence:
    """How a law depends on the time step of the simulation.

    An elasticity does not. A return map is taken once a step:

    - "none": it projects on a yield surface, and so often as one likes (identity, von Mises, Drucker-Prager).
    - "follows": it has the step among its constants, and flows by the rate that it has (viscous flow).
    - "fixed": a network decides it, which was trained on trial states of one step and on what returned of them. With
      another step it meets other trial states, as far beyond the surface as the step is long, and what it lets go in
      each comes more or less often. A network with a last layer of zeros decides nothing, and its base counts.
    """
    plasticity = law.plasticity
    if isinstance(plasticity, AdaptableConstitutive):
        if bool(plasticity.weights()[-1].any()):
            return "fixed"
        plasticity = getattr(plasticity, "analytic", None)
    return "follows" if isinstance(plasticity, Constants) and "dt" in plasticity.constants else "none"
