"""Settings of the estimate of the initial velocity and spin."""

from pydantic import Field

from neuma_lib.config.base import Section, internal


class VelocityConfig(Section):
    """Initial velocity and spin from the frames before contact."""

    views: tuple[int, ...] = internal((0,), "views of the video", min_length=1)
    ridge: float = Field(
        0.0,
        ge=0,
        description="penalty on the velocity along the viewing direction of the first view, relative to the curvature "
        "of the best determined axis",
    )
    initial_frames: int = Field(
        3, ge=2, description="frames of the first estimate, which predicts the time of contact"
    )
    # The errors of the static Gaussians are equal in all frames, so more frames add little.
    frames: int = internal(16, "maximum number of frames before contact, evenly spaced", ge=2)
    iterations: int = internal(30, "maximum number of Levenberg-Marquardt steps for a set of frames", ge=1)
    # Gaussians do not change their shading. Divided by the time to contact it bounds the error of the spin.
    angle_std: float = internal(0.01, "standard deviation of the apparent rotation [rad]", ge=0)
    # 11.3: one percent of chi-squared variables with three degrees of freedom exceed it. 0: keep any spin.
    spin_significance: float = internal(
        11.3, "squared spin in standard deviations, below which it is zero", ge=0
    )
    difference: float = internal(0.02, "half width of the central differences [m/s]", gt=0)
