"""Settings of the search for the analytic law that a video shows."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from neuma_lib.config.base import Compared, Section, internal
from neuma_lib.config.laws import LawConfig


class IdentifyConfig(Section):
    """Family and constants of the material, found in the video: the law without any training."""

    families: dict[str, LawConfig] = Field(
        {},
        description="candidates by name. Every constant that is given is fitted, from there or from the scene's prior "
        "if that fits better; nu is kept between 0 and 0.5",
    )
    views: tuple[int, ...] = Field(
        (0,),
        min_length=1,
        description="views of the video that are used; for a method that trains on "
        "other views than training.views, such as neuma_structured+views=0,1, those",
    )
    compare: Compared = Field("colour", description="what of the images counts, as `training.compare`")
    covariance_from: Literal["elastic", "total"] = Field(
        "total", description="deformation that stretches the Gaussians, as `training.covariance_from`"
    )
    gaussian_motion: Literal["mean", "affine"] = Field(
        "affine", description="how Gaussians follow their particles, as `training.gaussian_motion`"
    )
    frames: int = Field(33, ge=4, description="most frames that are compared, spread evenly over the video")
    refined_particles: int = Field(
        8000,
        ge=0,
        description="particles of the bodies that say what the coarseness of the reconstruction's changes, more than "
        "`geometry.particles`; 0: ignored",
    )
    pose_tolerance: float = Field(
        1e-3,
        ge=0,
        description="expected constant shift [m] and relative enlargement of the rendered body, fitted along",
    )
    resamplings: int = Field(
        2, ge=1, description="such bodies: their difference is a part of the uncertainty"
    )
    held_out: float = Field(
        0.25,
        gt=0,
        lt=1,
        description="part of the frames after the first contact, the last ones, that families are judged by",
    )
    pyramid: tuple[int, ...] = Field(
        (6, 12, 24, 96),
        min_length=1,
        description="images are averaged over squares, so many across, in turn: blurred images are what makes the fit "
        "converge from afar. An image with fewer pixels across is taken as it is",
    )
    iterations: int = Field(6, ge=1, description="most Levenberg-Marquardt steps at each size of the squares")
    min_gain: float = Field(
        0.01,
        gt=0,
        description="part of the squared residuals that a step must promise to save; a tenth of it in the last round",
    )
    difference: float = Field(
        0.04,
        gt=0,
        description="width of the forward differences of the unbounded constants (of logarithms: 4 %)",
    )
    longest_step: float = Field(
        1.0, gt=0, description="largest change of an unbounded constant in a step (of a logarithm: factor e)"
    )
    spread: float = internal(3.0, "expected distance of the unbounded constants from their start", gt=0)
    prune_factor: float = Field(
        4.0,
        gt=1,
        description="a family whose squared residuals exceed the best one's by this factor is not refined further; "
        "where held-out ones exceed the fitted ones by it, the fit to all frames begins anew",
    )
    penalty: float = Field(
        0.05,
        ge=0,
        description="what a constant costs: a family with one more must lower the held-out loss by this part",
    )
    tie: float = Field(
        0.15,
        ge=0,
        description="families whose penalised held-out losses differ by less than this part are a tie",
    )
    model_std: float = Field(
        0.05,
        ge=0,
        description="standard deviation of the logarithm of every constant beside that from the images, for what all "
        "images share: shape, volume, density and appearance of the reconstruction",
    )
    determined: float = Field(
        0.1,
        gt=0,
        description="a constant or combination is determined if the standard deviation of its logarithm is below this",
    )
