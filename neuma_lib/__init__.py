"""NeuMA: neural material adaptor for visual grounding of intrinsic dynamics (NeurIPS 2024), as a library.

Public names are loaded on first use, so that ``import neuma_lib`` is fast and loads no torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuma_lib.errors import InputError, NonFiniteError
    from neuma_lib.io.laws import load_law, save_law
    from neuma_lib.mechanics.analytic import analytic_law
    from neuma_lib.mechanics.law import Elasticity, Law, Plasticity
    from neuma_lib.sim.model import MPM
    from neuma_lib.sim.rollout import rollout
    from neuma_lib.sim.rollout import rollout as simulate
    from neuma_lib.sim.state import State, Trajectory

__version__ = "0.1.0"

__all__ = [
    "Elasticity",
    "InputError",
    "Law",
    "MPM",
    "NonFiniteError",
    "Plasticity",
    "State",
    "Trajectory",
    "__version__",
    "analytic_law",
    "load_law",
    "rollout",
    "save_law",
    "simulate",
]

_HOMES = {
    "Elasticity": "mechanics.law",
    "InputError": "errors",
    "Law": "mechanics.law",
    "MPM": "sim.model",
    "NonFiniteError": "errors",
    "Plasticity": "mechanics.law",
    "State": "sim.state",
    "Trajectory": "sim.state",
    "analytic_law": "mechanics.analytic",
    "load_law": "io.laws",
    "rollout": "sim.rollout",
    "save_law": "io.laws",
    "simulate": "sim.rollout:rollout",
}
"""Module of each public name below this package, and its name there if it differs."""


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, there = _HOMES[name].partition(":")
    value = getattr(importlib.import_module(f"{__name__}.{module}"), there or name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
