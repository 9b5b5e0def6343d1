"""Candidate materials: a law whose constants are unknown, and those constants as unbounded numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.catalogue import ELASTICITY, PLASTICITY, POISSON, Constant
from neuma_lib.mechanics.combinations import Values
from neuma_lib.sim.model import COURANT_LIMIT, MPM

_PARTS = {"elasticity": ELASTICITY, "plasticity": PLASTICITY}
_AT_THE_LIMIT = 0.999  # of the stiffness that the time step bears, since constants are rounded
_UNBOUNDED = 12.0  # logits beyond it are the bound, to six digits


_GUESS = {"E": 2e5, "nu": 0.3}
FAMILIES: dict[str, dict[str, dict[str, Any]]] = {
    "hencky": {"elasticity": {"name": "hencky", **_GUESS}},
    "fixed_corotated": {"elasticity": {"name": "fixed_corotated", **_GUESS}},
    "neo_hookean": {"elasticity": {"name": "neo_hookean", **_GUESS}},
    "von_mises": {
        "elasticity": {"name": "hencky", **_GUESS},
        "plasticity": {"name": "von_mises", "yield_stress": 5e3},
    },
    "drucker_prager": {
        "elasticity": {"name": "hencky", **_GUESS},
        "plasticity": {"name": "drucker_prager", "friction_angle": 30},
    },
    "viscous_flow": {
        "elasticity": {"name": "hencky", **_GUESS},
        "plasticity": {"name": "viscous_flow", "viscosity": 150},
    },
    "bingham": {
        "elasticity": {"name": "hencky", **_GUESS},
        "plasticity": {"name": "viscous_flow", "viscosity": 50, "yield_stress": 2e3},
    },
}
"""Candidate families with initial guesses of their constants, as in ``identify.families`` of the shipped settings."""


class Family:
    """A kind of material with constants to be found.

    Attributes:
        name: for results.
        spec: elasticity and plasticity by name, with guesses of all constants.
        constants: the names of the constants, in order.
        guess: their values in ``spec``.
    """

    def __init__(self, name: str, spec: Mapping[str, Mapping[str, Any]]):
        self.name, self.spec = name, spec
        self._admitted: dict[str, tuple[str, Constant]] = {}
        self.guess: Values = {}
        analytic_law(spec, dt=1.0, name=name)  # names unknown parts and constants, and those out of range
        for part, known in _PARTS.items():
            given = spec.get(part) or {"name": "identity"}
            for key, value in given.items():
                if key != "name":
                    self._admitted[key] = (part, known[given["name"]][key])
                    self.guess[key] = float(value)
        self.constants = tuple(self.guess)
        if own := {"E", "nu", "dt"} & set(spec.get("plasticity") or ()):
            raise InputError(
                f"identify.families.{name}.plasticity: leave out {', '.join(sorted(own))}: elasticity and scene say it"
            )

    def contains(self, other: Family) -> bool:
        """Whether a limit of the constants makes this family the other one, which has fewer."""
        flows = self.spec["plasticity"]["name"] in ("von_mises", "viscous_flow")
        same = self.spec["elasticity"]["name"] == other.spec["elasticity"]["name"]
        return flows and same and set(other.constants) < set(self.constants)

    def unbounded(self, values: Values) -> np.ndarray:
        """Logarithms, and logits of what has two bounds, shape (k,)."""
        return np.array([self._to(key, values[key]) for key in self.constants])

    def values(self, unbounded: np.ndarray, model: MPM, density: float) -> Values:
        """Constants of unbounded ones, with no more stiffness than the time step bears at the density [kg/m^3]."""
        values = self.bounded(unbounded)
        unit = analytic_law(self.law_spec({**values, "E": 1.0}), model.dt)
        stiffest = _AT_THE_LIMIT * (COURANT_LIMIT / model.courant(unit, density)) ** 2
        return {**values, "E": min(values["E"], stiffest)}

    def bounded(self, unbounded: np.ndarray) -> Values:
        """Constants of unbounded ones, however stiff."""
        return {key: self._back(key, u) for key, u in zip(self.constants, unbounded, strict=True)}

    def law_spec(self, values: Values) -> dict[str, dict[str, Any]]:
        """Specification of a law, as `analytic_law` takes it."""
        spec = {part: {"name": given["name"]} for part, given in self.spec.items()}
        for key, value in values.items():
            spec[self._admitted[key][0]][key] = value
        return spec

    def unbounded_dict(self, values: Values, covariance: np.ndarray) -> dict[str, Any]:
        """Unbounded constants with their covariance, for JSON: u = log(value - low) - log(high - value), the
        second term where there is an upper bound (``high`` is null where there is none)."""
        bounds = [self._bounds(key) for key in self.constants]
        return {
            "constants": list(self.constants),
            "values": self.unbounded(values).tolist(),
            "covariance": covariance.tolist(),
            "low": [low for low, _ in bounds],
            "high": [high if math.isfinite(high) else None for _, high in bounds],
        }

    def with_guesses(self, known: Values) -> Values:
        """Known constants, where the family has them and they lie within its bounds, and guesses for the others."""
        usable = {key: known[key] for key in self.constants if key in known and self._inside(key, known[key])}
        return {**self.guess, **usable}

    @property
    def flows(self) -> bool:
        """Whether it has constants that limit plastic flow."""
        return any(key not in ("E", "nu") for key in self.constants)

    def with_other_limits(self, values: Values, powers: Sequence[int]) -> list[Values]:
        """The same with what limits plastic flow times 4 to some powers (in logarithms, logits); none if elastic."""
        flow = np.array([key not in ("E", "nu") for key in self.constants])
        u = self.unbounded(values)
        return [self.bounded(u + math.log(4) * n * flow) for n in powers] if self.flows else []

    def _bounds(self, key: str) -> tuple[float, float]:
        constant = self._admitted[key][1]
        return (0.0, POISSON.high) if key == "nu" else (constant.low, constant.high)

    def _inside(self, key: str, value: float) -> bool:
        low, high = self._bounds(key)
        return low < value < high

    def _to(self, key: str, value: float) -> float:
        low, high = self._bounds(key)
        if not low < value < high:
            raise InputError(
                f"identify.families.{self.name}: {key} = {value:g} must lie between {low:g} and {high:g}"
            )
        return math.log(value - low) - (math.log(high - value) if math.isfinite(high) else 0.0)

    def _back(self, key: str, u: float) -> float:
        low, high = self._bounds(key)
        if math.isfinite(high):
            return low + (high - low) / (1 + math.exp(-min(max(u, -_UNBOUNDED), _UNBOUNDED)))
        return low + math.exp(u)
