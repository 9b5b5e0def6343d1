"""Settings of the identification of an analytic law from a video."""

from typing import Literal

from pydantic import Field

from neuma_lib.config.base import Compared, Section, internal
from neuma_lib.config.laws import LawConfig

FRICTION_NEEDS = "fitted needs contact of particles", "Set simulation.contact: particles"
"""Problem and remedy where friction is to be fitted with another contact."""


class IdentifyConfig(Section):
    """Identification of the family and the constants of the material from the video, without training."""

    families: dict[str, LawConfig] = Field(
        {},
        description="candidates by name. Every given constant is fitted, from its value here or from the scene's "
        "prior, whichever fits better; nu stays between 0 and 0.5",
    )
    views: tuple[int, ...] = Field(
        (0,),
        min_length=1,
        description="views of the video; a method that trains on views other than training.views uses those",
    )
    compare: Compared = Field("colour", description="compared quantity, as `training.compare`")
    covariance_from: Literal["elastic", "total"] = internal("total", "as `training.covariance_from`")
    gaussian_motion: Literal["mean", "affine"] = internal("affine", "as `training.gaussian_motion`")
    contact_friction: Literal["given", "fitted"] = Field(
        "given",
        description="Coulomb coefficient of the body and its obstacles: that of the scene, or fitted to the video, "
        "which needs `simulation.contact: particles`",
    )
    frames: int = Field(33, ge=4, description="maximum number of frames, evenly spaced")
    # A second discretisation for the constants of the material. Those of two grids are extrapolated.
    refined_particles: int = Field(
        8000,
        ge=0,
        description="particles of the bodies for the constants of the material, more than `geometry.particles`, on a "
        "finer grid, or on that of `simulation` if the truth has it too; 0: no constants of the material",
    )
    refinement: float = internal(
        1.5,
        "grid cells and steps of the finer grid, relative to the simulation's; 1: only more particles",
        ge=1,
    )
    pose_tolerance: float = internal(1e-3, "expected shift [m] and enlargement of the rendered body", ge=0)
    held_out: float = internal(
        0.25, "share of the frames after contact, the last, on which families are compared", gt=0, lt=1
    )
    # Blurred images make the fit converge from far away.
    pyramid: tuple[int, ...] = internal(
        (6, 12, 24, 96), "widths of the images that are fitted in turn", min_length=1
    )
    iterations: int = internal(10, "maximum number of Levenberg-Marquardt steps for each width", ge=1)
    level_plateaus: bool = internal(
        False, "plateaus of the loss are measured above its slope where a fit ends before its minimum"
    )
    min_gain: float = internal(0.01, "predicted relative gain below which a fit stops", gt=0)
    difference: float = internal(0.04, "width of the forward differences of the unbounded constants", gt=0)
    longest_step: float = internal(1.0, "maximum change of an unbounded constant in a step", gt=0)
    # A prior on constants that the video does not determine.
    spread: float = internal(3.0, "expected distance of the unbounded constants from their start", gt=0)
    prune_factor: float = internal(
        4.0,
        "families with squared residuals above this multiple of the best with their return map are dropped. If those "
        "of held-out frames exceed those of fitted ones by it, the fit to all frames restarts",
        gt=1,
    )
    penalty: float = Field(
        0.05, ge=0, description="relative decrease of the held-out loss required for each additional constant"
    )
    tie: float = internal(0.15, "relative difference of penalised losses below which families tie", ge=0)
    model_std: float = Field(
        0.05,
        ge=0,
        description="standard deviation of the logarithm of each constant from errors that all images share: shape, "
        "volume, density, appearance",
    )
    determined: float = internal(
        0.1, "standard deviation of a logarithm below which a quantity is determined", gt=0
    )
