"""Settings of PAC-NeRF's later stages: velocity, and constants of a named family of laws."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from neuma_lib.config.base import Section
from neuma_lib.config.laws import LawConfig

MODULI = ("mu", "kappa")
"""Shear and bulk modulus [Pa], which a family may be fitted in instead of E and nu."""
FITTED = ("E", "nu", *MODULI, "yield_stress", "viscosity", "friction_angle")
"""Constants that can be fitted."""


class PacFamilyConfig(LawConfig):
    """A family of laws: its stock guess, in this project's conventions, and which constants are fitted."""

    fitted: tuple[str, ...] = Field(
        min_length=1, description=f"constants that are fitted, of {', '.join(FITTED)}; the others stay"
    )

    @model_validator(mode="after")
    def _fits_its_law(self) -> PacFamilyConfig:
        known = {**self.elasticity.model_extra, **self.plasticity.model_extra, **dict.fromkeys(MODULI)}
        if wrong := [name for name in self.fitted if name not in FITTED or name not in known]:
            raise ValueError(f"fitted: {', '.join(wrong)} is no constant of the law that can be fitted")
        if {"E", "nu"} & set(self.fitted) and set(MODULI) & set(self.fitted):
            raise ValueError("fitted: give E and nu, or mu and kappa, not of both")
        return self


class PacNerfConfig(Section):
    """Velocity and constants (PAC-NeRF). In brackets what PAC-NeRF has published."""

    families: dict[str, PacFamilyConfig] = Field(
        {}, description="families of laws by name, with stock guesses"
    )
    family: str | None = Field(
        None,
        description="family that is fitted; null: the first one with the return map of the scene's prior",
    )
    guesses: Literal["stock", "prior"] = Field(
        "stock",
        description="constants that the fit starts from: those of the family, or those that the prior was trained on, "
        "where the family has them",
    )
    particles: int = Field(
        2000, ge=10, description="about how many particles move; all of the field's follow them (all of them)"
    )
    followed: int = Field(16, ge=4, description="nearest moving particles that one of the field's follows")
    least_opacity: float = Field(
        0.1,
        ge=0,
        lt=1,
        description="particles less opaque than this part of the most opaque one do not move by themselves (0.001)",
    )
    velocity_frames: int = Field(
        5, ge=1, description="most frames before contact that tell the velocity, evenly spread (5)"
    )
    velocity_iterations: int = Field(100, ge=1, description="most steps of L-BFGS for the velocity (100)")
    iterations_contact: int = Field(
        20, ge=0, description="Adam steps on the frames until a little after contact (50)"
    )
    iterations_all: int = Field(40, ge=1, description="Adam steps on all frames after that (100)")
    after_contact: float = Field(
        0.125, ge=0, description="how much that little is [s] (3 frames at 24 a second)"
    )
    most_frames: int = Field(
        12, ge=1, description="most frames of a step, evenly spread from contact on (12 to 18)"
    )
    pixels: int = Field(
        2048,
        ge=1,
        description="most pixels of a frame, at random among those that show the body (whole image)",
    )
    rate_modulus: float = Field(0.1, ge=0, description="learning rate of log10 E, mu and kappa (0.1)")
    rate_poisson: float = Field(0.03, ge=0, description="that of x with nu = 0.45 tanh(x / 0.45) (0.01)")
    rate_yield: float = Field(0.1, ge=0, description="that of log10 of the yield stress (0.1)")
    rate_viscosity: float = Field(0.05, ge=0, description="that of log10 of the viscosity (0.05)")
    rate_angle: float = Field(1.0, ge=0, description="that of the friction angle [degrees] (1)")
    rate_decay: float = Field(
        0.1, gt=0, le=1, description="last over first rate; they fall over the second half of all steps (1)"
    )
    betas: tuple[float, float] = Field(
        (0.5, 0.9),
        description="Adam's averaging factors (0.9, 0.999; with the first moduli overshoot and return over 20 steps,"
        " with the second large first gradients slow down all later steps)",
    )
    save_every: int = Field(5, ge=1, description="steps between two saves of the state")
