"""NeuMA: neural material adaptor for visual grounding of intrinsic dynamics (NeurIPS 2024), as a library.

Public names are loaded on first use, so that ``import neuma_lib`` is fast and loads no torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuma_lib.api import (
        Adaptation,
        Identification,
        Scene,
        Video,
        adapt,
        estimate_motion,
        evaluate,
        identify,
        render,
    )
    from neuma_lib.coupling.initial_motion import InitialMotion
    from neuma_lib.coupling.reconstruction import Reconstruction
    from neuma_lib.errors import InputError, NonFiniteError
    from neuma_lib.mechanics.law import Elasticity, Law, Plasticity
    from neuma_lib.methods.base import Method
    from neuma_lib.methods.registry import METHODS
    from neuma_lib.sim.model import MPM
    from neuma_lib.sim.rollout import rollout, simulate
    from neuma_lib.sim.state import State, Trajectory
    from neuma_lib.viewer.open import view

__version__ = "0.1.0"

__all__ = [
    "Adaptation",
    "Elasticity",
    "Identification",
    "InitialMotion",
    "InputError",
    "Law",
    "METHODS",
    "MPM",
    "Method",
    "NonFiniteError",
    "Plasticity",
    "Reconstruction",
    "Scene",
    "State",
    "Trajectory",
    "Video",
    "__version__",
    "adapt",
    "estimate_motion",
    "evaluate",
    "identify",
    "render",
    "rollout",
    "simulate",
    "view",
]

_HOMES = {
    "Adaptation": "api",
    "Elasticity": "mechanics.law",
    "Identification": "api",
    "InitialMotion": "coupling.initial_motion",
    "InputError": "errors",
    "Law": "mechanics.law",
    "METHODS": "methods.registry",
    "MPM": "sim.model",
    "Method": "methods.base",
    "NonFiniteError": "errors",
    "Plasticity": "mechanics.law",
    "Reconstruction": "coupling.reconstruction",
    "Scene": "api",
    "State": "sim.state",
    "Trajectory": "sim.state",
    "Video": "api",
    "adapt": "api",
    "estimate_motion": "api",
    "evaluate": "api",
    "identify": "api",
    "render": "api",
    "rollout": "sim.rollout",
    "simulate": "sim.rollout",
    "view": "viewer.open",
}
"""Module of each public name below this package."""


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
