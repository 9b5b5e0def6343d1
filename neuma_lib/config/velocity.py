"""Settings of the estimate of the initial velocity and spin."""

from __future__ import annotations

from pydantic import Field

from neuma_lib.config.base import Section


class VelocityConfig(Section):
    """Initial velocity and spin from the frames before contact."""

    views: tuple[int, ...] = Field((0,), min_length=1, description="views of the video that are used")
    ridge: float = Field(
        0.0,
        ge=0,
        description="penalty on the velocity along the viewing direction of the first view, relative to the curvature "
        "of the best determined axis; 0: none",
    )
    initial_frames: int = Field(
        3, ge=2, description="frames of the first estimate, which tells how many more come before contact"
    )
    frames: int = Field(
        16,
        ge=2,
        description="most frames that are compared, spread evenly over those before contact: what the static Gaussians "
        "get wrong is alike in all of them, so that more say little more",
    )
    iterations: int = Field(30, ge=1, description="most Levenberg-Marquardt steps for a set of frames")
    angle_std: float = Field(
        0.01,
        ge=0,
        description="standard deviation of the angle [rad] by which images seem to show a body turned that is not, "
        "because the Gaussians do not shade it as the light does; over the time to contact it bounds the spin",
    )
    spin_significance: float = Field(
        11.3,
        ge=0,
        description="squared distance of the spin from 0, in standard deviations, below which the body does not spin; "
        "11.3 is exceeded by one percent of chi-squared variables with three degrees of freedom; 0: any spin is kept",
    )
    difference: float = Field(
        0.02,
        gt=0,
        description="half width of the central differences [m/s], of the spin as the speed of the particles",
    )
