"""Constitutive laws: F -> tau and F_trial -> F, analytic, neural and structured."""

from __future__ import annotations

import importlib

_HOMES = {
    "Adaptor": "adaptor",
    "Constitutive": "law",
    "Elasticity": "law",
    "Law": "law",
    "NeuralLaw": "neural",
    "Plasticity": "law",
    "StructuredLaw": "structured",
    "analytic_law": "analytic",
    "neural_law": "neural",
    "structured_law": "structured",
}
__all__ = list(_HOMES)


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
