"""Families of candidate laws, and their constants as unbounded unknowns."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.catalogue import PARTS, POISSON, Constant
from neuma_lib.mechanics.combinations import Values
from neuma_lib.sim.model import MPM

FRICTION = "contact_friction"
"""Name of the Coulomb coefficient of a body and its obstacles, a constant that belongs to no law."""
_FRICTION_GUESS = 0.5
_PAIR = "friction"  # name of the coefficient of a pair after those of its bodies
_NO_FLOW = ("E", "nu", FRICTION)
MAX_COURANT = 0.7
"""Largest Courant number of fitted constants. A correction may stiffen the law up to `catalogue.COURANT_LIMIT`."""
_MAX_LOGIT = 12.0  # logits beyond it equal the bound to six digits


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
    """A kind of material with constants to estimate.

    Attributes:
        name: name in the results.
        spec: elasticity and plasticity by name, with initial guesses of all constants.
        constants: names of the constants in order.
        guess: their values in ``spec``.
        contact_friction: whether the last constant is `FRICTION`.
    """

    def __init__(self, name: str, spec: Mapping[str, Mapping[str, Any]], contact_friction: bool = False):
        self.name, self.spec, self.contact_friction = name, spec, contact_friction
        self._constants: dict[str, tuple[str, Constant]] = {}
        self.guess: Values = {}
        analytic_law(spec, dt=1.0, name=name)  # checks names and ranges
        for part, known in PARTS.items():
            given = {key: value for key, value in (spec.get(part) or {}).items() if key != "name"}
            if twice := set(given) & set(self.guess) - {"E", "nu", "dt"}:
                problem = f"{', '.join(twice)} is a constant of the plasticity as well"
                raise InputError(f"identify.families.{name}.{part}", problem, "Use another viscous part")
            for key, value in given.items():
                self._constants[key] = (part, known[spec[part]["name"]][key])
                self.guess[key] = float(value)
        if contact_friction:
            self._constants[FRICTION], self.guess[FRICTION] = ("", Constant("1", 0.0)), _FRICTION_GUESS
        self.constants = tuple(self.guess)
        for part in ("plasticity", "viscosity"):
            if own := {"E", "nu", "dt"} & set(spec.get(part) or ()):
                raise InputError(
                    f"identify.families.{name}.{part}",
                    f"{', '.join(sorted(own))} must not be set, since the elasticity and the scene define it",
                )

    def contains(self, other: "Family") -> bool:
        """Whether the other family, with fewer constants, is a limit of this one."""
        more = self.return_map in ("von_mises", "viscous_flow") or self._viscous or self.field
        same = self.spec["elasticity"]["name"] == other.spec["elasticity"]["name"]
        same = same and other.field in (None, self.field)
        return bool(more) and same and set(other.constants) < set(self.constants)

    def varies(self, other: "Family") -> bool:
        """Whether this is the other, uniform family with a field."""
        uniform = tuple(key for key, (part, _) in self._constants.items() if part != "field")
        return self.field is not None and uniform == other.constants and self.contains(other)

    def unbounded(self, values: Values) -> np.ndarray:
        """Unbounded constants (k,): logarithms, or logits of constants with two bounds."""
        return np.array([self.unbounded_of(key, values[key]) for key in self.constants])

    def values(self, unbounded: np.ndarray, model: MPM, density: float) -> Values:
        """Constants from unbounded ones, with E and the viscous part limited at a density [kg/m^3] by `MAX_COURANT`."""
        return self.limited(self.bounded(unbounded), model, density)

    def limited(self, values: Values, model: MPM, density: float) -> Values:
        """Constants with E and the viscous part limited at a density [kg/m^3] by `MAX_COURANT`."""
        if self._viscous:
            number = model.courant(analytic_law(self.law_spec(values), model.dt), density)
            softer = min(1.0, (MAX_COURANT / number) ** 2)
            return {
                key: value * softer if key in ("E", *self._viscous) else value
                for key, value in values.items()
            }
        unit = analytic_law(self.law_spec({**values, "E": 1.0}), model.dt)
        stiffest = (MAX_COURANT / model.courant(unit, density)) ** 2
        return {**values, "E": min(values["E"], stiffest)}

    def bounded(self, unbounded: np.ndarray) -> Values:
        """Constants from unbounded ones, without a limit on the stiffness."""
        return {key: self.bounded_of(key, u) for key, u in zip(self.constants, unbounded, strict=True)}

    def law_spec(self, values: Values) -> dict[str, dict[str, Any]]:
        """Specification of a law for `analytic_law`."""
        spec = {part: {"name": given["name"]} for part, given in self.spec.items()}
        for key, value in values.items():
            if key != FRICTION:
                spec[self._constants[key][0]][key] = value
        return spec

    def pair_frictions(self, values: Values) -> list[float] | None:
        """Coulomb coefficients of the pairs of bodies. None: one body."""
        return None

    def unbounded_dict(self, values: Values, covariance: np.ndarray) -> dict[str, Any]:
        """Unbounded constants of the law with their covariance, for JSON: u = log(value - low) - log(high - value),
        without the second term if there is no upper bound (``high`` is null)."""
        own = self.constants[: len(self.constants) - self.contact_friction]
        bounds, k = [self._bounds(key) for key in own], len(own)
        return {
            "constants": list(own),
            "values": self.unbounded(values)[:k].tolist(),
            "covariance": covariance[:k, :k].tolist(),
            "low": [low for low, _ in bounds],
            "high": [high if math.isfinite(high) else None for _, high in bounds],
        }

    def with_guesses(self, known: Values) -> Values:
        """Known constants of the family that lie within its bounds, and guesses for the others."""
        usable = {key: known[key] for key in self.constants if key in known and self._inside(key, known[key])}
        return {**self.guess, **usable}

    @property
    def return_map(self) -> str:
        """Name of its plasticity."""
        return (self.spec.get("plasticity") or {"name": "identity"})["name"]

    @property
    def field(self) -> str | None:
        """Name of its field, None if it is uniform."""
        return (self.spec.get("field") or {"name": None})["name"]

    @property
    def flows(self) -> bool:
        """Whether it has constants that limit plastic flow."""
        return bool(self._flow)

    def with_other_limits(self, values: Values, powers: Sequence[int]) -> list[Values]:
        """Values with constants of plastic flow, or of a body without flow the ratio of its field, times 4 to each
        power (in logarithms or logits); none of a uniform elastic body."""
        varied = np.array([key in (self._flow or ("ratio",)) for key in self.constants])
        u = self.unbounded(values)
        return [self.bounded(u + math.log(4) * n * varied) for n in powers] if varied.any() else []

    @property
    def _flow(self) -> tuple[str, ...]:
        """Constants that limit plastic flow: those of the plasticity and, as E and nu, others of the elasticity."""
        return tuple(
            key
            for key in self.constants
            if key not in _NO_FLOW and self._constants[key][0] not in ("viscosity", "field")
        )

    @property
    def _viscous(self) -> tuple[str, ...]:
        """Constants of the viscous part to which its stress is proportional."""
        return tuple(
            key for key, (part, _) in self._constants.items() if part == "viscosity" and key != "relaxation"
        )

    def _bounds(self, key: str) -> tuple[float, float]:
        constant = self._constants[key][1]
        return (0.0, POISSON.high) if key == "nu" else (constant.low, constant.high)

    def _inside(self, key: str, value: float) -> bool:
        low, high = self._bounds(key)
        return low < value < high

    def unbounded_of(self, key: str, value: float) -> float:
        """Logarithm or logit of a constant."""
        low, high = self._bounds(key)
        if not low < value < high:
            where = f"identify.families.{self.name}.{key}"
            raise InputError(where, f"{value:g} must lie between {low:g} and {high:g}")
        return math.log(value - low) - (math.log(high - value) if math.isfinite(high) else 0.0)

    def bounded_of(self, key: str, u: float) -> float:
        """Inverse of `unbounded_of`."""
        low, high = self._bounds(key)
        if math.isfinite(high):
            return low + (high - low) / (1 + math.exp(-min(max(u, -_MAX_LOGIT), _MAX_LOGIT)))
        return low + math.exp(u)


class Bodies:
    """A family for each of several bodies that touch each other, with the Coulomb coefficients of their pairs.

    Attributes:
        families: of each body.
        constants: names of the constants to estimate in order, ``duck.E`` of a body and ``duck-ball.friction`` of a
            pair.
        guess: values of all constants, also of known ones.
        contact_friction: False, since the obstacles have the friction of the scene.

    Args:
        families: by name of the body.
        pairs: indices of the bodies of each pair.
        known: constants that are not estimated.
    """

    contact_friction = False

    def __init__(
        self, families: Mapping[str, Family], pairs: Sequence[tuple[int, int]], known: Values | None = None
    ):
        self.families, self.bodies = list(families.values()), list(families)
        self.name = ", ".join(f"{body} {family.name}" for body, family in families.items())
        self._pairs = [f"{self.bodies[a]}-{self.bodies[b]}.{_PAIR}" for a, b in pairs]
        self.guess: Values = {
            f"{body}.{key}": value for body, family in families.items() for key, value in family.guess.items()
        }
        self.guess |= dict.fromkeys(self._pairs, _FRICTION_GUESS) | dict(known or {})
        self.constants = tuple(key for key in self.guess if key not in (known or {}))

    def of_body(self, k: int, values: Values) -> Values:
        """The constants of a body under their own names."""
        return {key: values[f"{self.bodies[k]}.{key}"] for key in self.families[k].constants}

    def own(self, k: int) -> list[int]:
        """Indices of the constants of a body among those to estimate."""
        return [i for i, key in enumerate(self.constants) if key.startswith(f"{self.bodies[k]}.")]

    @property
    def pairs(self) -> dict[str, int]:
        """Index of each friction to estimate, by name."""
        return {key: i for i, key in enumerate(self.constants) if key in self._pairs}

    def unbounded(self, values: Values) -> np.ndarray:
        """As `Family.unbounded`, of the constants to estimate."""
        return np.array([self._of(key).unbounded_of(_own(key), values[key]) for key in self.constants])

    def bounded(self, unbounded: np.ndarray) -> Values:
        """As `Family.bounded`, with the known constants."""
        new = {
            key: self._of(key).bounded_of(_own(key), u)
            for key, u in zip(self.constants, unbounded, strict=True)
        }
        return self.guess | new

    def values(self, unbounded: np.ndarray, model: MPM, density: float) -> Values:
        """As `Family.values`."""
        values = self.bounded(unbounded)
        for k, (body, family) in enumerate(zip(self.bodies, self.families, strict=True)):
            limited = family.limited(self.of_body(k, values), model, density)
            values |= {f"{body}.{key}": value for key, value in limited.items()}
        return values

    def law_spec(self, values: Values) -> list[dict[str, dict[str, Any]]]:
        """Specifications of the laws of all bodies."""
        return [family.law_spec(self.of_body(k, values)) for k, family in enumerate(self.families)]

    def pair_frictions(self, values: Values) -> list[float]:
        """Coulomb coefficients of the pairs of bodies."""
        return [values[key] for key in self._pairs]

    def _of(self, key: str) -> Family:
        """The family of a constant. A friction is transformed as that of any family with obstacles."""
        return _OF_PAIRS if key in self._pairs else self.families[self.bodies.index(key.rpartition(".")[0])]


def _own(key: str) -> str:
    """Name of a constant in its family."""
    name = key.rpartition(".")[2]
    return FRICTION if name == _PAIR else name


_OF_PAIRS = Family("pairs", {"elasticity": {"name": "hencky", **_GUESS}}, contact_friction=True)
