"""Analytic laws from a specification, as written in the tables of scenes and priors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from neuma_lib.mechanics.catalogue import complete
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
    parts = complete(spec, dt)
    names = [part.pop("name") for part in parts.values()]
    elasticity = ELASTICITIES[names[0]](**parts["elasticity"])
    return Law(elasticity, PLASTICITIES[names[1]](**parts["plasticity"]), name or " + ".join(names))


def specification(elasticity: AnalyticElasticity, plasticity: Plasticity) -> dict[str, Any]:
    """The specification of two analytic parts, complete: with E, nu and dt where a plasticity has them."""
    parts = {"elasticity": elasticity, "plasticity": plasticity}
    return {
        name: {"name": NAMES[type(part)], **{key: float(value) for key, value in part.values.items()}}
        for name, part in parts.items()
    }
