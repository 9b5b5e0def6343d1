"""Settings of the static reconstruction: how Gaussians are fitted to the views at t = 0."""

from __future__ import annotations

from pydantic import Field

from neuma_lib.config.base import Section, internal


class DensificationConfig(Section):
    """When and where Gaussians are added and removed."""

    start: float = Field(0.1, ge=0, description="fraction of the iterations at which adding begins")
    stop: float = Field(0.6, ge=0, description="fraction of the iterations at which adding ends")
    every: int = internal(100, "iterations between two rounds", ge=1)
    max_count: int = Field(2000, ge=1, description="Gaussians at most")
    growth: float = Field(0.15, ge=0, description="largest fraction of Gaussians added in a round")
    split_scale: float = Field(
        1.0,
        gt=0,
        description="a Gaussian whose largest standard deviation exceeds this many times that of the start is split in "
        "two, a smaller one is cloned",
    )
    min_opacity: float = Field(0.02, ge=0, description="Gaussians below are removed at each round")


class GaussiansConfig(Section):
    """Fit of static Gaussians to the views (paper Sec. 3.1)."""

    iterations: int = Field(1500, ge=1, description="optimiser steps, each on `batch` views")
    batch: int = Field(1, ge=1, description="views a step")
    initial_count: int = Field(1000, ge=1, description="Gaussians at the start")
    interior: float = Field(
        0.15,
        ge=0,
        le=1,
        description="fraction of them placed inside the hull, the others lie near its surface",
    )
    initial_opacity: float = Field(
        0.9,
        gt=0,
        lt=1,
        description="opacity at the start, and for good of Gaussians that no camera ever sees",
    )
    hull_resolution: int = Field(
        64, ge=2, description="voxels along the longest side of the hull's bounding box"
    )
    sh_degree: int = Field(1, ge=0, le=3, description="highest degree of the spherical harmonics")
    ssim_weight: float = Field(0.2, ge=0, le=1, description="share of SSIM in the image loss, the rest is L1")
    anisotropy_weight: float = Field(0.1, ge=0, description="weight of the regulariser of the anisotropy")
    max_anisotropy: float = Field(
        4.0, ge=1, description="ratio of longest to shortest axis above which that regulariser acts"
    )
    min_scale: float = Field(
        0.1, gt=0, description="least standard deviation, as a fraction of the mean spacing of the start"
    )
    max_scale: float = Field(
        2.0, gt=0, description="largest standard deviation, as a fraction of the mean spacing of the start"
    )
    rate_means: float = Field(
        0.02,
        ge=0,
        description="learning rate of the centres in mean spacings of the start; falls to a hundredth",
    )
    rate_scales: float = Field(
        0.02, ge=0, description="learning rate of the log scales; it and those below fall to a tenth"
    )
    rate_quats: float = Field(0.01, ge=0, description="learning rate of the rotations")
    rate_opacities: float = Field(0.05, ge=0, description="learning rate of the opacities (logits)")
    rate_colours: float = Field(0.02, ge=0, description="learning rate of the mean colours")
    rate_harmonics: float = Field(0.002, ge=0, description="learning rate of the higher spherical harmonics")
    cull_opacity: float = Field(
        0.02, ge=0, description="Gaussians at most this opaque are removed at the end (paper: 0.02)"
    )
    held_out: int = Field(
        10, ge=0, description="every how many-th view is kept for measurement only; 0 for none"
    )
    densification: DensificationConfig = Field(
        DensificationConfig(), description="rounds of adding and removing Gaussians"
    )
