"""Combinations of material constants that can be identifiable from motion when single constants are not."""

from collections.abc import Mapping
from typing import Any

Values = dict[str, float]  # constants by name, in SI units and degrees


def constants_of(spec: Mapping[str, Mapping[str, Any] | None]) -> Values:
    """Constants of all parts of the specification of a law."""
    return {
        key: float(value) for part in spec.values() for key, value in (part or {}).items() if key != "name"
    }


def physical(values: Values) -> Values:
    """The positive quantities to combine: shear and bulk modulus G, K [Pa] in place of E and nu, then the others."""
    E, nu = values["E"], values["nu"]
    rest = {key: value for key, value in values.items() if key not in ("E", "nu")}
    return {"G": E / (2 * (1 + nu)), "K": E / (3 * (1 - 2 * nu)), **rest}


def named_combinations(values: Values) -> Values:
    """Candidates for identifiable quantities by name: moduli [Pa], constants, and ratios that govern flow."""
    named = {"E": values["E"], **physical(values)}
    if "yield_stress" in values:
        named["yield_strain"] = values["yield_stress"] / (2 * named["G"])
    if "viscosity" in values:
        named["relaxation_time"] = values["viscosity"] / named["G"]
    return named
