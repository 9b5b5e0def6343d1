"""Constitutive laws: F -> tau and F_trial -> F, analytic, neural and structured."""

from neuma_lib.mechanics.adaptor import Adaptor
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Constitutive, Elasticity, Law, Plasticity
from neuma_lib.mechanics.neural import NeuralLaw, neural_law
from neuma_lib.mechanics.structured import StructuredLaw, structured_law

__all__ = [
    "Adaptor",
    "Constitutive",
    "Elasticity",
    "Law",
    "NeuralLaw",
    "Plasticity",
    "StructuredLaw",
    "analytic_law",
    "neural_law",
    "structured_law",
]
