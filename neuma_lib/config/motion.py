"""Options that all methods share: how a motion is simulated and observed."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from neuma_lib.config.base import Section


class MotionOptions(Section):
    """How bodies are simulated, and how their Gaussians follow."""

    carrier: Literal["binding", "gaussians"] = Field(
        "binding", description="bound volume particles, or the Gaussians themselves as particles (w/o Bind)"
    )
    views: tuple[int, ...] = Field((0,), min_length=1, description="training views of the video")
    covariance_from: Literal["elastic", "total"] = Field(
        "elastic",
        description="deformation that stretches the Gaussians: the elastic F (paper), or the total one, which includes "
        "plastic flow",
    )
    gaussian_motion: Literal["mean", "affine"] = Field(
        "mean",
        description="how Gaussians follow their particles: by their mean displacement (paper), or by their affine "
        "motion, which also rotates and stretches the distance of a Gaussian from them",
    )
    start: Literal["estimated", "identified"] = Field(
        "estimated",
        description="initial motion: estimated from the frames before contact (paper), or fitted to all frames along "
        "with the constants (stage `identify`)",
    )
    assumed_density: float | None = Field(
        None, gt=0, description="density that the method assumes [kg/m^3]; null: the scene's density"
    )


class WithPrior(Section):
    """The option of methods that start from a prior."""

    prior: str | None = Field(
        None,
        description="prior: one of priors.laws, or `identified`, the law identified in the video; null: the scene's",
    )
