"""Constitutive laws: F -> tau and F_trial -> F, analytic and neural."""

from neuma_lib.mechanics.adaptor import Adaptor
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Constitutive, Elasticity, Law, Plasticity
from neuma_lib.mechanics.neural import NeuralLaw, neural_law

__all__ = [
    "Adaptor",
    "Constitutive",
    "Elasticity",
    "Law",
    "NeuralLaw",
    "Plasticity",
    "analytic_law",
    "neural_law",
]
