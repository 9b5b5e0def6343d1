"""Analytic laws from a specification, as used in the settings of scenes and priors."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.mechanics.catalogue import complete
from neuma_lib.mechanics.elasticity import ELASTICITIES
from neuma_lib.mechanics.fields import FIELDS, Field
from neuma_lib.mechanics.law import Elasticity, Law, Plasticity
from neuma_lib.mechanics.plasticity import PLASTICITIES
from neuma_lib.mechanics.viscosity import VISCOSITIES, Viscosity


def analytic_law(spec: Mapping[str, Any], dt: float | None = None, name: str | None = None) -> Law:
    """Build a law from a specification such as

    ``{"elasticity": {"name": "hencky", "E": 3e5, "nu": 0.25}, "plasticity": {"name": "von_mises",
    "yield_stress": 5e3}}``

    Args:
        spec: the parts, each with its ``name`` and constants. A plasticity inherits E and nu from the elasticity
            by default. A missing plasticity is the identity. A ``viscosity`` and a ``field`` are optional.
        dt: time step [s], required by rate-dependent parts (with the constant ``dt``).
        name: name used in messages, by default composed of the names of the parts.

    Raises:
        InputError: a part, name or constant is unknown or missing, or a constant is outside its interval.
    """
    parts = complete(spec, dt)
    names = [part.pop("name") for part in parts.values()]
    kinds = {
        "elasticity": ELASTICITIES,
        "plasticity": PLASTICITIES,
        "viscosity": VISCOSITIES,
        "field": FIELDS,
    }
    built = {
        part: kinds[part][own](**values) for own, (part, values) in zip(names, parts.items(), strict=True)
    }
    return Law(**built, name=name or " + ".join(names))


def name_of(part: Any) -> str | None:
    """Name of an analytic part in specifications, None if it has none."""
    return next((name for name, kind in part.named.items() if kind is type(part)), None)


def specification(
    elasticity: Elasticity,
    plasticity: Plasticity,
    viscosity: Viscosity | None = None,
    field: Field | None = None,
) -> dict[str, Any]:
    """Complete specification of analytic parts, including inherited constants (E, nu, dt).

    Raises:
        InputError: a part has no name or does not hold constants, so that a specification cannot describe it.
    """
    given = {"elasticity": elasticity, "plasticity": plasticity, "viscosity": viscosity, "field": field}
    parts = {name: part for name, part in given.items() if part is not None}
    for key, part in parts.items():
        if name_of(part) is None or not hasattr(part, "values"):
            problem = f"{type(part).__name__} is not described by a name and constants"
            raise InputError(
                key, problem, "Derive it from AnalyticElasticity or AnalyticPlasticity, with a name"
            )
    return {
        name: {"name": name_of(part), **{key: _number(value) for key, value in part.values.items()}}
        for name, part in parts.items()
    }


def _number(value: float | Tensor) -> float:
    return float(value.detach() if isinstance(value, Tensor) else value)
