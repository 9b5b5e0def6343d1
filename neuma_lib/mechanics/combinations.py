"""Combinations of material constants that motion may determine where it does not determine each of them."""

from __future__ import annotations

Values = dict[str, float]
"""Constants by name, in SI units and degrees."""


def physical(values: Values) -> Values:
    """The positive quantities that combinations are made of: shear and bulk modulus G, K [Pa] for E and nu, then the
    other constants."""
    E, nu = values["E"], values["nu"]
    rest = {key: value for key, value in values.items() if key not in ("E", "nu")}
    return {"G": E / (2 * (1 + nu)), "K": E / (3 * (1 - 2 * nu)), **rest}


def named_combinations(values: Values) -> Values:
    """What a video may determine, by name: moduli [Pa], constants, and ratios that govern flow."""
    found = {"E": values["E"], **physical(values)}
    if "yield_stress" in values:
        found["yield_strain"] = values["yield_stress"] / (2 * found["G"])
    if "viscosity" in values:
        found["relaxation_time"] = values["viscosity"] / found["G"]
    return found
