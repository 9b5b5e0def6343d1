"""Settings of PAC-NeRF's later stages: velocity, and constants of a named family of laws."""

from typing import Literal, Self

from pydantic import Field, model_validator

from neuma_lib.config.base import Section, internal
from neuma_lib.config.laws import LawConfig

MODULI = ("mu", "kappa")  # shear and bulk modulus [Pa], which a family may be fitted in instead of E and nu
FITTED = ("E", "nu", *MODULI, "yield_stress", "viscosity", "friction_angle")  # constants that can be fitted


class PacFamilyConfig(LawConfig):
    """A family of laws: initial values in the conventions of this project, and the fitted constants."""

    fitted: tuple[str, ...] = Field(
        min_length=1, description=f"constants that are fitted, of {', '.join(FITTED)}"
    )

    @model_validator(mode="after")
    def _fits_its_law(self) -> Self:
        known = {**self.elasticity.model_extra, **self.plasticity.model_extra, **dict.fromkeys(MODULI)}
        if wrong := [name for name in self.fitted if name not in FITTED or name not in known]:
            raise ValueError(f"fitted: {', '.join(wrong)} is not a constant of the law that can be fitted")
        if self.viscosity is not None:
            raise ValueError("viscosity: PAC-NeRF has no viscous part of solids. Leave it out")
        if {"E", "nu"} & set(self.fitted) and set(MODULI) & set(self.fitted):
            raise ValueError("fitted: give E and nu, or mu and kappa, not both pairs")
        return self


class PacNerfConfig(Section):
    """Velocity and constants (PAC-NeRF). Published values are in brackets."""

    families: dict[str, PacFamilyConfig] = Field(
        {}, description="families of laws by name, with published initial values"
    )
    family: str | None = Field(
        None, description="family that is fitted; null: the first with the return map of the scene's prior"
    )
    guesses: Literal["stock", "prior"] = Field(
        "stock",
        description="initial constants: `stock`, those of the family, or `prior`, those of the prior if the family has "
        "them",
    )
    particles: int = internal(
        2000, "approximate number of moving particles, which all particles of the field follow (all)", ge=10
    )
    followed: int = internal(16, "nearest moving particles that a particle of the field follows", ge=4)
    min_opacity: float = internal(
        0.1, "relative opacity below which particles do not move by themselves (0.001)", ge=0, lt=1
    )
    velocity_frames: int = internal(5, "maximum number of frames before contact for the velocity (5)", ge=1)
    velocity_iterations: int = internal(100, "maximum number of L-BFGS steps for the velocity (100)", ge=1)
    iterations_contact: int = internal(20, "Adam steps on the frames until after contact (50)", ge=0)
    iterations_all: int = internal(40, "Adam steps on all frames after that (100)", ge=1)
    after_contact: float = internal(
        0.125, "time after contact until which the first steps look [s] (3 frames at 24/s)", ge=0
    )
    max_frames: int = internal(12, "maximum number of frames of a step, from contact on (12 to 18)", ge=1)
    pixels: int = internal(
        2048, "maximum number of random pixels of a frame near the body (whole image)", ge=1
    )
    rate_modulus: float = internal(0.1, "learning rate of log10 E, mu and kappa (0.1)", ge=0)
    rate_poisson: float = internal(0.03, "learning rate of x with nu = 0.45 tanh(x / 0.45) (0.01)", ge=0)
    rate_yield: float = internal(0.1, "learning rate of log10 of the yield stress (0.1)", ge=0)
    rate_viscosity: float = internal(0.05, "learning rate of log10 of the viscosity (0.05)", ge=0)
    rate_angle: float = internal(1.0, "learning rate of the friction angle [degrees] (1)", ge=0)
    rate_decay: float = internal(
        0.1, "last over first rate; they decay over the second half of all steps (1)", gt=0, le=1
    )
    betas: tuple[float, float] = internal(
        (0.5, 0.9), "averaging factors of Adam (0.9, 0.999, which overshoot in few steps)"
    )
    save_every: int = internal(5, "steps between checkpoints", ge=1)
