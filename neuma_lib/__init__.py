"""NeuMA: neural material adaptor for visual grounding of intrinsic dynamics (NeurIPS 2024), as a library.

Public names are loaded on first use, so that ``import neuma_lib`` is fast and loads no torch.
"""

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
    )  # fmt: skip
    from neuma_lib.coupling.initial_motion import InitialMotion
    from neuma_lib.coupling.reconstruction import Reconstruction
    from neuma_lib.errors import InputError, NonFiniteError
    from neuma_lib.mechanics.law import Elasticity, Law, Plasticity
    from neuma_lib.methods.base import Method
    from neuma_lib.methods.registry import METHODS
    from neuma_lib.sim.bodies import Pair
    from neuma_lib.sim.model import MPM
    from neuma_lib.sim.rollout import rollout, simulate
    from neuma_lib.sim.state import State, Trajectory
    from neuma_lib.viewer.open import view

__version__ = "0.1.0"

__all__ = [
    "Adaptation", "Elasticity", "Identification", "InitialMotion", "InputError", "Law", "METHODS", "MPM", "Method",
    "NonFiniteError", "Pair", "Plasticity", "Reconstruction", "Scene", "State", "Trajectory", "Video",
    "__version__", "adapt", "estimate_motion", "evaluate", "identify", "render", "rollout", "simulate", "view",
]  # fmt: skip

_PUBLIC = {
    "api": "Adaptation Identification Scene Video adapt estimate_motion evaluate identify render",
    "coupling.initial_motion": "InitialMotion",
    "coupling.reconstruction": "Reconstruction",
    "errors": "InputError NonFiniteError",
    "mechanics.law": "Elasticity Law Plasticity",
    "methods.base": "Method",
    "methods.registry": "METHODS",
    "sim.bodies": "Pair",
    "sim.model": "MPM",
    "sim.rollout": "rollout simulate",
    "sim.state": "State Trajectory",
    "viewer.open": "view",
}
"""Public names of each module below this package."""
_MODULES = {name: module for module, names in _PUBLIC.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
