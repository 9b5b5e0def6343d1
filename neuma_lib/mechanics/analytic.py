"""Analytic laws from a specification, as written in the tables of scenes and priors."""

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
    """Law of a specification such as

    ``{"elasticity": {"name": "hencky", "E": 3e5, "nu": 0.25}, "plasticity": {"name": "von_mises",
    "yield_stress": 5e3}}``

    Args:
        spec: the two parts, each with its ``name`` and constants. A plasticity takes E and nu from the elasticity
            unless it has its own; a missing plasticity is the identity.
        dt: time step [s], needed by rate-dependent plasticity (one with the constant ``dt``).
        name: for messages; made of the parts' names if not given.

    Raises:
        InputError: unknown part, name or constant, a missing one, or one outside its interval.
    """
    unknown = sorted(set(spec) - {"elasticity", "plasticity"})
    if unknown or "elasticity" not in spec:
        raise InputError(
            f"a material has the keys elasticity and plasticity, not {', '.join(map(str, spec)) or 'none'}"
        )
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
            raise InputError(f"plasticity {plastic_name} depends on the rate: give the time step dt")
        plastic["dt"] = dt
    return Law(elasticity, plastic_type(**plastic), name or f"{elastic_name} + {plastic_name}")


def specification(elasticity: AnalyticElasticity, plasticity: Plasticity) -> dict[str, Any]:
    """The specification of two analytic parts, complete: with E, nu and dt where a plasticity has them."""
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
    raise InputError(f"{part}.name: {name!r} is unknown{hint}; choose from {', '.join(choices)}")
