"""Constants of a family of laws in the parametrisation of PAC-NeRF (Li et al. 2023), and selection of the family.

As in the authors' code, moduli, yield stress and viscosity are stored as log10, Poisson's ratio as x with
nu = 0.45 tanh(x / 0.45), and the friction angle in degrees.
"""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.catalogue import lame
from neuma_lib.mechanics.combinations import constants_of
from neuma_lib.mechanics.law import Law
from neuma_lib.methods.pac_nerf.options import MODULI, PacFamilyConfig, PacNerfConfig

MAX_POISSON = 0.45  # bound on Poisson's ratio (PAC-NeRF)
ANGLES = (0.5, 85.0)  # bounds on the friction angle [degrees], which the authors' code does not have


class FamilyConstants(torch.nn.Module):
    """The constants of a family of laws, with the fitted ones as parameters.

    Args:
        family: parts of the law with published initial constants, and names of the fitted ones.
        known: other initial constants by name; those that the family does not have are ignored.

    Raises:
        InputError: an initial constant is outside the range of the parametrisation.
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
        analytic_law(spec, dt=1.0)  # checks names and ranges
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
        """The fitted numbers by the names in the settings."""
        return {name: float(_from_stored(name, self.stored[name])) for name in self.fitted}

    def values(self) -> dict[str, Tensor]:
        """The fitted numbers as constants of the law, differentiable."""
        values = {name: _from_stored(name, self.stored[name]) for name in self.fitted}
        if set(MODULI) & set(values):
            mu, kappa = (values.pop(name, self.fixed[name]) for name in MODULI)
            values["E"] = 9 * kappa * mu / (3 * kappa + mu)
            values["nu"] = (3 * kappa - 2 * mu) / (2 * (3 * kappa + mu))
        return values

    def law(self, dt: float, device: torch.device | str = "cpu") -> Law:
        """The law, differentiable in the fitted constants; dt [s] is used by rate-dependent laws."""
        values = {name: value.to(device) for name, value in self.values().items()}
        return analytic_law(self._filled(values), dt=dt)

    @torch.no_grad()
    def specification(self) -> dict[str, dict[str, Any]]:
        """The specification for `analytic_law` with numbers as constants."""
        return self._filled({name: float(value) for name, value in self.values().items()})

    def groups(self, settings: PacNerfConfig) -> list[dict[str, Any]]:
        """Parameter groups with learning rates for an optimiser."""
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
        if not abs(value) < MAX_POISSON:
            problem = f"the size of {value:g} must be below {MAX_POISSON} to be fitted"
            raise InputError("pac_nerf.families.nu", problem)
        return MAX_POISSON * math.atanh(value / MAX_POISSON)
    if not value > 0:
        raise InputError(f"pac_nerf.families.{name}", f"{value:g} must be positive to be fitted")
    return math.log10(value)


def _from_stored(name: str, stored: Tensor) -> Tensor:
    if name == "friction_angle":
        return stored.clamp(*ANGLES)
    if name == "nu":
        return MAX_POISSON * torch.tanh(stored / MAX_POISSON)
    return 10**stored


def choose_family(
    settings: PacNerfConfig, prior: Mapping[str, Mapping[str, Any]] | None
) -> tuple[str, FamilyConstants]:
    """The family of a scene and its initial constants.

    Args:
        settings: the families, and optionally the name of one.
        prior: specification of the analytic law of the scene's prior, or None.

    Raises:
        InputError: the family does not exist, or cannot be selected without an analytic prior.
    """
    families, name = settings.families, settings.family
    if prior is None and (name is None or settings.guesses == "prior"):
        problem = "it cannot be selected because the scene's prior is a file, not an analytic law"
        raise InputError("pac_nerf.family", problem, "Set pac_nerf.family, and pac_nerf.guesses to stock")
    if name is None:
        plasticity = prior["plasticity"]["name"]
        matching = [key for key, family in families.items() if family.plasticity.name == plasticity]
        if not matching:
            problem = f"none has the return map {plasticity} of the scene's prior"
            raise InputError("pac_nerf.families", problem, "Add one, or set pac_nerf.family")
        name = matching[0]
    if name not in families:
        raise InputError("pac_nerf.family", f"{name!r} must be one of {', '.join(families)}")
    known = constants_of(prior or {}) if settings.guesses == "prior" else None
    return name, FamilyConstants(families[name], known)
