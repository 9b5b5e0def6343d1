"""Settings of PAC-NeRF's first stage: a voxel radiance field from the views at t = 0."""

from __future__ import annotations

from pydantic import Field, model_validator

from neuma_lib.config.base import Section


class RadianceConfig(Section):
    """Voxel radiance field of the views at t = 0 (PAC-NeRF). What differs from the authors' values says so."""

    iterations: int = Field(
        1500, ge=1, description="optimiser steps, each on one view (authors: 6001, plasticine 10001)"
    )
    rays: int = Field(
        1024,
        ge=1,
        description="pixels of a step, at random among those whose ray meets the lattice (authors: 2^17 of 800 x 800)",
    )
    particles: int = Field(
        12000, ge=1, description="about how many fill the visual hull at the end, which decides the voxel"
    )
    voxel: float | None = Field(
        None,
        gt=0,
        description="voxel of the coarsest lattice [m] (authors: 0.16, some scenes 0.1 or 0.12); null: by particles",
    )
    hull_resolution: int = Field(
        32,
        ge=2,
        description="voxels along the visual hull, in whose box the field begins (authors: a box by hand)",
    )
    halvings: tuple[float, ...] = Field(
        (0.17, 0.33, 0.67),
        description="fractions of the iterations at which the voxel is halved (authors: at 1000, 2000, 4000)",
    )
    initial_opacity: float = Field(
        1e-4, gt=0, lt=1, description="opacity of raw density 0, where all begins, over one interval"
    )
    spacing: float = Field(
        1.0,
        gt=0,
        le=1,
        description="mean distance between neighbouring particles [voxels] (authors: 0.5, eight a voxel)",
    )
    least_opacity: float = Field(
        1e-3,
        ge=0,
        lt=1,
        description="particles less opaque than this part of the most opaque one are left out",
    )
    rate_density: float = Field(
        0.8,
        ge=0,
        description="learning rate of the raw density on the coarsest lattice; doubles with each halving, as"
        " what makes a voxel opaque does (authors: 0.1 on all)",
    )
    rate_features: float = Field(0.1, ge=0, description="learning rate of the colour features")
    rate_network: float = Field(1e-3, ge=0, description="learning rate of the network of the colours")
    rate_decay: float = Field(
        0.1,
        gt=0,
        le=1,
        description="last over first of these rates: they fall exponentially after the last halving (authors: 1)",
    )
    entropy_weight: float = Field(
        1e-4,
        ge=0,
        description="weight of the entropy of a ray's transmittance, at the start (authors: 1e-4, some scenes 1e-3)",
    )
    entropy_doublings: int = Field(
        6, ge=0, description="times that this weight doubles, evenly over the iterations"
    )
    entropy_most: float = Field(0.1, ge=0, description="largest weight of the entropy")
    volume_weight: float = Field(
        1e-3,
        ge=0,
        description="weight of the particles' opacities times volume over voxel (authors: 1e-3, plasticine 1e-4)",
    )
    held_out: int = Field(10, ge=2, description="every how many-th view is kept for measurement only")
    checkpoint_every: int = Field(100, ge=1, description="iterations between two saves of the state")

    @model_validator(mode="after")
    def _ascending(self) -> RadianceConfig:
        if list(self.halvings) != sorted(set(self.halvings)) or not all(0 < f < 1 for f in self.halvings):
            raise ValueError("radiance.halvings: give fractions between 0 and 1, ascending, none twice")
        return self
