"""Options that all methods share: simulation of a motion, and motion of the Gaussians."""

from typing import Literal

from pydantic import Field

from neuma_lib.config.base import Section, internal


class MotionOptions(Section):
    """Simulation of bodies, and motion of their Gaussians."""

    # "gaussians": the Gaussians are the particles (w/o Bind).
    particle_source: Literal["binding", "gaussians"] = internal("binding", "particles that are simulated")
    views: tuple[int, ...] = Field((0,), min_length=1, description="training views of the video")
    covariance_from: Literal["elastic", "total"] = Field(
        "elastic",
        description="deformation of the Gaussians: elastic F (paper), or total F, which includes plastic flow",
    )
    gaussian_motion: Literal["mean", "affine"] = Field(
        "mean",
        description="motion of a Gaussian: mean displacement of its particles (paper), or their affine motion",
    )
    start: Literal["estimated", "identified"] = Field(
        "estimated",
        description="initial motion: estimated from the frames before contact (paper), or fitted to all frames by the "
        "identification",
    )
    assumed_density: float | None = Field(
        None, gt=0, description="density that the method assumes [kg/m^3]; null: the scene's"
    )


class WithPrior(Section):
    """The option of methods that start from a prior."""

    prior: str | None = Field(
        None,
        description="a name in priors.laws, or `identified`, the law identified from the video; null: the scene's",
    )
