"""Constitutive laws: F -> tau and F_trial -> F, analytic and neural."""

from neuma_lib.materials.analytic import analytic_law
from neuma_lib.materials.base import Constitutive, Elasticity, Law, Plasticity
from neuma_lib.materials.lora import Adaptor
from neuma_lib.materials.neural import NeuralLaw, neural_law
from neuma_lib.materials.priors import load_prior

__all__ = [
    "Adaptor",
    "Constitutive",
    "Elasticity",
    "Law",
    "NeuralLaw",
    "Plasticity",
    "analytic_law",
    "load_prior",
    "neural_law",
]
