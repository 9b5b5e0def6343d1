"""The built-in analytic laws: names, constants, units and bounds. Imports no torch, so that settings can be checked
before it is loaded.

A specification has the parts ``elasticity`` and optionally ``plasticity``, ``viscosity`` and ``field``, each with its
``name`` and constants: ``{"elasticity": {"name": "hencky", "E": 3e5, "nu": 0.25}, "plasticity": {"name": "von_mises",
"yield_stress": 5e3}}``
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from itertools import product
from typing import Any

import numpy as np

from neuma_lib.errors import InputError

COURANT_LIMIT = 0.8
"""Largest stable c dt / dx. Between 1.0 and 1.2 a rollout still looks finite while its gradients explode."""


@dataclass(frozen=True)
class Constant:
    """A material constant: its unit and admissible open interval (closed if ``closed``)."""

    unit: str
    low: float
    high: float = math.inf
    closed: bool = False
    default: float | None = None

    def admits(self, value: float) -> bool:
        if self.closed:
            return self.low <= value <= self.high
        return self.low < value < self.high

    @property
    def bounds(self) -> str:
        """The interval in words that follow "must"."""
        unit = "" if self.unit in ("", "1") else f" {self.unit}"
        if math.isfinite(self.high):
            return f"lie between {self.low:g} and {self.high:g}{unit}"
        return f"be {'at least' if self.closed else 'greater than'} {self.low:g}{unit}"


YOUNG = Constant("Pa", 0.0)
POISSON = Constant("1", -1.0, 0.5)
MODULI = {"E": YOUNG, "nu": POISSON}
_STRESS = Constant("Pa", 0.0, closed=True)
_STEP = Constant("s", 0.0)
_DIRECTION = {
    "azimuth": Constant("degrees", -180.0, 180.0, closed=True, default=0.0),
    "elevation": Constant("degrees", -90.0, 90.0, closed=True, default=0.0),
}

ELASTICITY: dict[str, dict[str, Constant]] = {
    "fixed_corotated": MODULI,
    "stvk": MODULI,
    "hencky": MODULI,
    "neo_hookean": MODULI,
    "fluid": MODULI,
    "tait": MODULI,
    # Above 20, powers of the stretches of a crushed element overflow in float32.
    "ogden": {**MODULI, "alpha": Constant("1", 0.0, 20.0)},
    "mooney_rivlin": {**MODULI, "q": Constant("1", 0.0, 1.0, closed=True)},
    "fibre_reinforced": {
        **MODULI,
        "fibre_modulus": _STRESS,
        "fibre_exponent": Constant("1", 0.0, closed=True),
        **_DIRECTION,
    },
}
"""Constants of the elasticities by name."""

PLASTICITY: dict[str, dict[str, Constant]] = {
    "identity": {},
    "von_mises": {**MODULI, "yield_stress": _STRESS},
    "drucker_prager": {
        **MODULI,
        "friction_angle": Constant("degrees", 0.0, 90.0),
        "cohesion": Constant("1", 0.0, closed=True, default=0.0),
    },
    "fluid_projection": {},
    "viscous_flow": {
        **MODULI,
        "viscosity": Constant("Pa s", 0.0),
        "dt": _STEP,
        "yield_stress": Constant("Pa", 0.0, closed=True, default=0.0),
    },
    "crushable_foam": {
        **MODULI,
        "crush": Constant("Pa", 0.0),
        "tension": Constant("Pa", 0.0),
        "slope": Constant("1", 0.0),
        "dt": _STEP,
        "relaxation": Constant("s", 0.0, closed=True, default=0.0),
    },
    "herschel_bulkley": {
        **MODULI,
        "consistency": Constant("Pa s^exponent", 0.0),
        "exponent": Constant("1", 0.2, 3.0, closed=True),
        "yield_stress": _STRESS,
        "dt": _STEP,
    },
    "cohesive_drucker_prager": {
        **MODULI,
        "friction_angle": Constant("degrees", 0.0, 90.0),
        "cohesion": _STRESS,
        "dilation_angle": Constant("degrees", 0.0, 90.0, closed=True, default=0.0),
    },
}
"""Constants of the return maps by name. E, nu and dt default to those of the elasticity and of the simulation."""


VISCOSITY: dict[str, dict[str, Constant]] = {
    "kelvin_voigt": {"viscosity": Constant("Pa s", 0.0), "dt": _STEP},
    "maxwell": {"modulus": Constant("Pa", 0.0), "relaxation": Constant("s", 0.0), "dt": _STEP},
}
"""Constants of the viscous parts by name. dt defaults to that of the simulation."""

FIELD: dict[str, dict[str, Constant]] = {
    "ramp": {"ratio": Constant("1", 0.0), **_DIRECTION},
    "halves": {"ratio": Constant("1", 0.0), "boundary": Constant("1", 0.0, 1.0), **_DIRECTION},
}
"""Constants of the fields by name (`neuma_lib.mechanics.fields`)."""

PARTS = {"elasticity": ELASTICITY, "plasticity": PLASTICITY, "viscosity": VISCOSITY, "field": FIELD}
"""Constants of all laws by part and name."""


DEFINED_IN: dict[tuple[str, str], str] = {}
"""Modules or Python files of laws that are not built in, by part and name."""


def register(part: str, name: str, constants: Mapping[str, Constant], module: str) -> None:
    """Add a law that is not built in.

    Args:
        part: "elasticity" or "plasticity".
        module: module or Python file that defines it.

    Raises:
        InputError: another module has a law with this name.
    """
    laws = {"elasticity": ELASTICITY, "plasticity": PLASTICITY}[part]
    if name in laws and (other := DEFINED_IN.get((part, name))) != module:
        owner = f"{other} defines" if other else "the built-in laws have"
        remedy = "Choose another name. If it is the same file, load it only once: import it, or list it in extensions"
        problem = f"{owner} another {part} {name!r}"
        raise InputError(module, problem, remedy if other else "Choose another name")
    laws[name], DEFINED_IN[part, name] = dict(constants), module


def complete(spec: Mapping[str, Any], dt: float | None = None) -> dict[str, dict[str, Any]]:
    """A specification with elasticity and plasticity, E and nu in a plasticity that has these constants, and dt in
    parts that have it. A viscosity and a field are parts of the result if they are given.

    Args:
        spec: a plasticity inherits E and nu from the elasticity by default. A missing plasticity is the identity.
        dt: time step [s], required by parts with the constant ``dt``.

    Raises:
        InputError: a part or its name is unknown or missing, or the time step is. Constants are not checked.
    """
    if "elasticity" not in spec or not set(spec) <= set(PARTS):
        keys = ", ".join(map(str, spec)) or "none"
        problem = f"its keys must be elasticity and optionally plasticity, viscosity and field, not {keys}"
        raise InputError("law", problem)
    elastic = dict(spec["elasticity"])
    plastic = dict(spec.get("plasticity") or {"name": "identity"})
    _known_name("elasticity", elastic, ELASTICITY)
    needed = PLASTICITY[_known_name("plasticity", plastic, PLASTICITY)]
    for key in MODULI:
        if key in needed and key in elastic:
            plastic.setdefault(key, elastic[key])
    parts = {"elasticity": elastic, "plasticity": plastic}
    for part in ("viscosity", "field"):
        if spec.get(part):
            parts[part] = dict(spec[part])
            _known_name(part, parts[part], PARTS[part])
    for part, own in parts.items():
        if "dt" in PARTS[part][own["name"]] and "dt" not in own:
            if dt is None:
                raise InputError("dt", f"{part} {own['name']} is rate-dependent and needs the time step")
            own["dt"] = dt
    return parts


def check_law(spec: Mapping[str, Any], dt: float | None = None) -> dict[str, dict[str, Any]]:
    """The complete specification of a law, with numbers and defaults; arguments as of `complete`.

    Raises:
        InputError: what `complete` refuses, or a constant is unknown, missing, no number or outside its interval.
    """
    checked = {}
    for part, own in complete(spec, dt).items():
        name = own.pop("name")
        checked[part] = {"name": name, **check_constants(part, PARTS[part][name], own)}
    return checked


def check_constants(
    law: str, constants: Mapping[str, Constant], values: Mapping[str, Any]
) -> dict[str, float]:
    """Numbers of a law's constants in their order, defaults included.

    Args:
        law: what to call it in messages.

    Raises:
        InputError: a constant is unknown, missing, no number or outside its interval.
    """
    if unknown := sorted(set(values) - set(constants)):
        names = ", ".join(constants) or "none"
        raise InputError(law, f"unknown constant {', '.join(unknown)}; its constants are {names}")
    numbers: dict[str, float] = {}
    for name, constant in constants.items():
        value = values.get(name, constant.default)
        if value is None:
            raise InputError(f"{law}.{name}", f"this constant is missing. It must {constant.bounds}")
        try:
            numbers[name] = float(value)
        except (TypeError, ValueError):
            raise InputError(f"{law}.{name}", f"{value!r} is not a number") from None
        if not constant.admits(numbers[name]):
            raise InputError(f"{law}.{name}", f"{numbers[name]:g} must {constant.bounds}")
    if "dilation_angle" in constants and numbers["dilation_angle"] > numbers["friction_angle"]:
        raise InputError(
            f"{law}.dilation_angle",
            f"{numbers['dilation_angle']:g} must not exceed friction_angle = {numbers['friction_angle']:g}, since "
            "shear would generate energy",
        )
    return numbers


def at_length_scale(spec: Mapping[str, Any], scale: float) -> dict[str, Any]:
    """A law in a world whose lengths are ``scale`` times as long, at the same densities and times.

    Stresses and viscosities scale with length^2.
    """
    return {
        part: {
            key: value * scale**2
            if key in PARTS[part][values["name"]] and "Pa" in PARTS[part][values["name"]][key].unit
            else value
            for key, value in values.items()
        }
        for part, values in spec.items()
    }


def lame(E, nu):
    """Lamé parameters mu, lam [Pa] of Young's modulus E [Pa] and Poisson's ratio nu, numbers or tensors."""
    return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))


def viscous_branch(values):
    """Shear modulus [Pa] and relaxation time [s] of the branch of a `VISCOSITY`, numbers or tensors.

    Args:
        values: its constants, dt included.
    """
    if "modulus" in values:
        return values["modulus"], values["relaxation"]
    return values["viscosity"] / values["dt"], values["dt"]


def viscous_stiffness(values: Mapping[str, float]) -> float:
    """What a viscous part adds to the longitudinal modulus in the limit of the time step [Pa].

    In the fastest vibration that the steps of length dt can have, the sign changes with every step. The strain of a
    spring of modulus G that relaxes by the factor a = 1 / (1 + dt / T) in a step is then 2 a / (1 + a) times that of
    the body, so that it acts as one of modulus G / (1 + dt / (2 T)).

    Args:
        values: constants of a `VISCOSITY`, dt included.
    """
    modulus, relaxation = viscous_branch(values)
    return 4 / 3 * modulus / (1 + values["dt"] / (2 * relaxation))


def stiffest(field: Mapping[str, Any] | None) -> float:
    """Largest factor of a `FIELD` on the stress, 1 without one."""
    return max(1.0, field["ratio"]) if field else 1.0


def longitudinal_modulus(elasticity: Mapping[str, Any]) -> float:
    """Largest eigenvalue of the acoustic tensor of a checked elasticity at F = I [Pa], as `Law.longitudinal_modulus`.

    Isotropic laws: lam + 2 mu, or lam of a fluid. Fibres along a with modulus H add H (a . n)^2 a (x) a to the acoustic
    tensor of the direction n; the same 26 directions are evaluated.
    """
    mu, lam = lame(elasticity["E"], elasticity["nu"])
    if elasticity["name"] == "fluid":
        return max(lam, 0.0)
    if "fibre_modulus" not in elasticity:
        return lam + 2 * mu
    azimuth, elevation = (math.radians(elasticity[key]) for key in ("azimuth", "elevation"))
    a = np.array([
        math.cos(elevation) * math.cos(azimuth),
        math.sin(elevation),
        math.cos(elevation) * math.sin(azimuth),
    ])  # fmt: skip
    n = np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    Q = (lam + mu) * n[:, :, None] * n[:, None] + mu * np.eye(3)
    Q += elasticity["fibre_modulus"] * ((n @ a) ** 2)[:, None, None] * np.outer(a, a)
    return float(np.linalg.eigvalsh(Q).max())


def _known_name(part: str, values: Mapping[str, Any], choices: Mapping[str, Any]) -> str:
    name = values.get("name")
    if name in choices:
        return name
    close = get_close_matches(str(name), choices, n=1)
    hint = f"; did you mean {close[0]}?" if close else ""
    own = "A law of your own is known after its module is imported, in settings by extensions"
    remedy = f"Choose one of {', '.join(choices)}. {own}"
    raise InputError(f"{part}.name", f"{name!r} is unknown{hint}", remedy)
