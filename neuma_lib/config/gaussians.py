"""Settings of the static reconstruction: the fit of Gaussians to the views at t = 0."""

from pydantic import Field

from neuma_lib.config.base import Section, internal


class DensificationConfig(Section):
    """Addition and removal of Gaussians during the fit."""

    start: float = internal(0.1, "fraction of the iterations at which additions start", ge=0)
    stop: float = internal(0.6, "fraction of the iterations at which additions stop", ge=0)
    every: int = internal(100, "iterations between two rounds", ge=1)
    max_count: int = Field(2000, ge=1, description="maximum number of Gaussians")
    growth: float = internal(0.15, "maximum fraction of Gaussians added in a round", ge=0)
    # Relative to the largest standard deviation at the start.
    split_scale: float = internal(1.0, "size above which a Gaussian is split, below it is cloned", gt=0)
    min_opacity: float = internal(0.02, "opacity below which a round removes Gaussians", ge=0)


class GaussiansConfig(Section):
    """Fit of static Gaussians to the views (paper Sec. 3.1)."""

    iterations: int = Field(1500, ge=1, description="optimiser steps")
    batch: int = internal(1, "views per step", ge=1)
    initial_count: int = Field(1000, ge=1, description="Gaussians at the start")
    interior: float = internal(
        0.15, "fraction of these inside the hull, the others are near its surface", ge=0, le=1
    )
    # Gaussians that no camera sees keep it.
    initial_opacity: float = internal(0.9, "opacity at the start", gt=0, lt=1)
    hull_resolution: int = Field(
        64, ge=2, description="voxels along the longest side of the bounding box of the visual hull"
    )
    sh_degree: int = Field(1, ge=0, le=3, description="highest degree of the spherical harmonics")
    ssim_weight: float = internal(0.2, "share of SSIM in the image loss, the rest is L1", ge=0, le=1)
    anisotropy_weight: float = internal(0.1, "weight of the regulariser of the anisotropy", ge=0)
    max_anisotropy: float = internal(4.0, "ratio of the axes above which that regulariser acts", ge=1)
    # Sizes and the rate of the centres are relative to the mean spacing at the start.
    min_scale: float = internal(0.1, "minimum standard deviation", gt=0)
    max_scale: float = internal(2.0, "maximum standard deviation", gt=0)
    rate_means: float = internal(0.02, "learning rate of the centres, decays to a hundredth", ge=0)
    rate_scales: float = internal(
        0.02, "learning rate of the log scales, decays to a tenth as those below", ge=0
    )
    rate_quats: float = internal(0.01, "learning rate of the rotations", ge=0)
    rate_opacities: float = internal(0.05, "learning rate of the opacities (logits)", ge=0)
    rate_colours: float = internal(0.02, "learning rate of the mean colours", ge=0)
    rate_harmonics: float = internal(0.002, "learning rate of the higher spherical harmonics", ge=0)
    cull_opacity: float = internal(
        0.02, "opacity up to which Gaussians are removed at the end (paper: 0.02)", ge=0
    )
    held_out: int = internal(10, "every n-th view is held out for measurement; 0: none", ge=0)
    densification: DensificationConfig = Field(
        DensificationConfig(), description="addition and removal of Gaussians"
    )
