"""Constants of a family of laws as PAC-NeRF (Li et al. 2023) fits them, and the family of a scene.

They are stored as the authors store them: moduli, yield stress and viscosity as log10, Poisson's ratio as x with
nu = 0.45 tanh(x / 0.45), the friction angle in degrees.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.isotropic import lame
from neuma_lib.mechanics.law import Law
from neuma_lib.methods.pac_nerf.options import MODULI, PacFamilyConfig, PacNerfConfig

POISSON_MOST = 0.45
"""Bound on Poisson's ratio (PAC-NeRF)."""
ANGLES = (0.5, 85.0)
"""Friction angles that a law is given [degrees]; the authors have no bounds, but a cone needs some."""


class FamilyConstants(torch.nn.Module):
    """The constants of a family of laws, those that are fitted as parameters.

    Args:
        family: parts of the law with the constants of the stock guess, and which are fitted.
        known: constants to start from instead, by name, where the family has them.

    Raises:
        InputError: a guess that the parametrisation cannot hold.
    """

    def __init__(self, family: PacFamilyConfig, known: Mapping[str, float] | None = None):
        super().__init__()
        spec = family.plain()
        del spec["fitted"]
        self.spec: dict[str, dict[str, Any]] = spec
        self.fitted = family.fitted
        for part in spec.values():
            part.update(
                {name: (known or {}).get(name, value) for name, value in part.items() if name != "name"}
            )
        analytic_law(spec, dt=1.0)  # names unknown parts and constants, and those out of range
        E, nu = (spec["elasticity"][name] for name in ("E", "nu"))
        mu, _ = lame(E, nu)
        start = {**spec["plasticity"], "E": E, "nu": nu, "mu": mu, "kappa": E / (3 * (1 - 2 * nu))}
        self.fixed = {name: start[name] for name in MODULI}
        self.stored = torch.nn.ParameterDict({
            name: torch.nn.Parameter(torch.tensor(_to_stored(name, start[name]), dtype=torch.float64))
            for name in self.fitted
        })  # fmt: skip

    @torch.no_grad()
    def fitted_numbers(self) -> dict[str, float]:
        """What is fitted, under the names that it is fitted by."""
        return {name: float(_from_stored(name, self.stored[name])) for name in self.fitted}

    def values(self) -> dict[str, Tensor]:
        """What is fitted, as the law's own constants, differentiable."""
        found = {name: _from_stored(name, self.stored[name]) for name in self.fitted}
        if set(MODULI) & set(found):
            mu, kappa = (found.pop(name, self.fixed[name]) for name in MODULI)
            found["E"] = 9 * kappa * mu / (3 * kappa + mu)
            found["nu"] = (3 * kappa - 2 * mu) / (2 * (3 * kappa + mu))
        return found

    def law(self, dt: float, device: torch.device | str = "cpu") -> Law:
        """The law, differentiable with respect to what is fitted; dt [s] counts where it depends on the rate."""
        values = {name: value.to(device) for name, value in self.values().items()}
        return analytic_law(self._filled(values), dt=dt)

    @torch.no_grad()
    def specification(self) -> dict[str, dict[str, Any]]:
        """Names and constants as numbers, as `analytic_law` takes them."""
        return self._filled({name: float(value) for name, value in self.values().items()})

    def groups(self, settings: PacNerfConfig) -> list[dict[str, Any]]:
        """Groups of parameters with their learning rates, for an optimiser."""
        rates = {
            **dict.fromkeys(("E", *MODULI), settings.rate_modulus),
            "nu": settings.rate_poisson,
            "yield_stress": settings.rate_yield,
            "viscosity": settings.rate_viscosity,
            "friction_angle": settings.rate_angle,
        }
        return [
            {"params": [self.stored[name]], "first_lr": rates[name], "name": name} for name in self.fitted
        ]

    def _filled(self, values: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        return {
            part: {name: values.get(name, value) for name, value in given.items()}
            for part, given in self.spec.items()
        }


def _to_stored(name: str, value: float) -> float:
    if name == "friction_angle":
        return value
    if name == "nu":
        if not abs(value) < POISSON_MOST:
            raise InputError(
                f"pac_nerf: nu = {value:g} cannot be fitted, its size must be below {POISSON_MOST}"
            )
        return POISSON_MOST * math.atanh(value / POISSON_MOST)
    if not value > 0:
        raise InputError(f"pac_nerf: {name} = {value:g} cannot be fitted, it must be positive")
    return math.log10(value)


def _from_stored(name: str, stored: Tensor) -> Tensor:
    if name == "friction_angle":
        return stored.clamp(*ANGLES)
    if name == "nu":
        return POISSON_MOST * torch.tanh(stored / POISSON_MOST)
    return 10**stored


def choose_family(
    settings: PacNerfConfig, prior: Mapping[str, Mapping[str, Any]] | None
) -> tuple[str, FamilyConstants]:
    """The family of a scene and its constants at the start, by the rule of the settings.

    Args:
        settings: families, and which one, if it is named.
        prior: the analytic law of the scene's prior, as `analytic_law` takes it; None where there is none.

    Raises:
        InputError: there is no such family, or no prior to choose by.
    """
    families, name = settings.families, settings.family
    if prior is None and (name is None or settings.guesses == "prior"):
        raise InputError(
            "pac_nerf: the scene's prior is a file, not an analytic law: set pac_nerf.family, and guesses: stock"
        )
    if name is None:
        plasticity = prior["plasticity"]["name"]
        fitting = [key for key, family in families.items() if family.plasticity.name == plasticity]
        if not fitting:
            raise InputError(
                f"pac_nerf: no family has the prior's return map {plasticity}: add one to pac_nerf.families, or set "
                "pac_nerf.family"
            )
        name = fitting[0]
    if name not in families:
        raise InputError(
            f"pac_nerf.family: no {name!r} in pac_nerf.families, which has {', '.join(families)}"
        )
    known = {key: value for part in (prior or {}).values() for key, value in part.items() if key != "name"}
    return name, FamilyConstants(families[name], known if settings.guesses == "prior" else None)
