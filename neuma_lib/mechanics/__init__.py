"""Constitutive laws: F -> tau and F_trial -> F, analytic, neural and structured."""
