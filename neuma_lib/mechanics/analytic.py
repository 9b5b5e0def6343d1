"""Analytic laws from a specification, as used in the settings of scenes and priors."""

from __future__ import annotations

from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

from neuma_lib.errors import InputError
from neuma_lib.mechanics.elasticity import ELASTICITIES, AnalyticElasticity
from neuma_lib.mechanics.law import Law, Plasticity
from neuma_lib.mechanics.plasticity import PLASTICITIES

NAMES = {kind: name for name, kind in (ELASTICITIES | PLASTICITIES).items()}


def analytic_law(spec: Mapping[str, Any], dt: float | None = None, name: str | None = None) -> Law:
    """Build a law from a specification such as

    ``{"elasticity": {"name": "hencky", "E": 3e5, "nu": 0.25}, "plasticity": {"name": "von_mises",
    "yield_stress": 5e3}}``

    Args:
        spec: the two parts, each with its ``name`` and constants. A plasticity inherits E and nu from the elasticity
            by default. A missing plasticity is the identity.
        dt: time step [s], required by rate-dependent plasticity (with the constant ``dt``).
        name: name used in messages, by default composed of the names of the parts.

    Raises:
        InputError: a part, name or constant is unknown or missing, or a constant is outside its interval.
    """
    if "elasticity" not in spec or not set(spec) <= {"elasticity", "plasticity"}:
        keys = ", ".join(map(str, spec)) or "none"
        raise InputError("law", f"its keys must be elasticity and optionally plasticity, not {keys}")
    elastic = dict(spec["elasticity"])
    plastic = dict(spec.get("plasticity") or {"name": "identity"})
    elastic_type = _choose("elasticity", elastic, ELASTICITIES)
    plastic_type = _choose("plasticity", plastic, PLASTICITIES)
    elastic_name, plastic_name = elastic.pop("name"), plastic.pop("name")
    elasticity = elastic_type(**elastic)
    for key in ("E", "nu"):
        if key in plastic_type.constants:
            plastic.setdefault(key, elasticity.values[key])
    if "dt" in plastic_type.constants and "dt" not in plastic:
        if dt is None:
            raise InputError("dt", f"plasticity {plastic_name} is rate-dependent and needs the time step")
        plastic["dt"] = dt
    return Law(elasticity, plastic_type(**plastic), name or f"{elastic_name} + {plastic_name}")


def specification(elasticity: AnalyticElasticity, plasticity: Plasticity) -> dict[str, Any]:
    """Complete specification of two analytic parts, including inherited constants of the plasticity (E, nu, dt)."""
    parts = {"elasticity": elasticity, "plasticity": plasticity}
    return {
        name: {"name": NAMES[type(part)], **{key: float(value) for key, value in part.values.items()}}
        for name, part in parts.items()
    }


def _choose(part: str, values: Mapping[str, Any], choices: Mapping[str, type]) -> type:
    name = values.get("name")
    if name in choices:
        return choices[name]
    close = get_close_matches(str(name), choices, n=1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    raise InputError(f"{part}.name", f"{name!r} is unknown{hint}", f"Choose one of {', '.join(choices)}")
