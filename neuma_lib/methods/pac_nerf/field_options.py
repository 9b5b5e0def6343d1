"""Settings of PAC-NeRF's first stage: a voxel radiance field from the views at t = 0."""

from typing import Self

from pydantic import Field, model_validator

from neuma_lib.config.base import Section, internal


class RadianceConfig(Section):
    """Voxel radiance field of the views at t = 0 (PAC-NeRF). Published values are in brackets."""

    iterations: int = Field(
        1500, ge=1, description="optimiser steps, each on one view (6001, plasticine 10001)"
    )
    rays: int = internal(
        1024, "random pixels of a step whose ray intersects the lattice (2^17 of 800 x 800)", ge=1
    )
    particles: int = internal(
        12000, "approximate number of particles in the hull, which defines the voxel", ge=1, le=2_000_000
    )
    voxel: float | None = internal(
        None,
        "voxel of the coarsest lattice [m] (0.16, some scenes 0.1 or 0.12); null: from particles",
        ge=0.005,
    )
    hull_resolution: int = internal(
        32, "voxels along the visual hull, in whose box the field starts (a box by hand)", ge=2
    )
    halvings: tuple[float, ...] = internal(
        (0.17, 0.33, 0.67),
        "fractions of the iterations at which the voxel is halved (1000, 2000, 4000)",
        max_length=6,
    )
    initial_opacity: float = internal(1e-4, "initial opacity over one interval, at raw density 0", gt=0, lt=1)
    spacing: float = internal(
        1.0, "mean distance between neighbouring particles [voxels] (0.5, eight per voxel)", gt=0, le=1
    )
    min_opacity: float = internal(1e-3, "relative opacity below which particles are omitted", ge=0, lt=1)
    rate_density: float = internal(
        0.8, "learning rate of the raw density on the coarsest lattice, doubles with each halving (0.1)", ge=0
    )
    rate_features: float = internal(0.1, "learning rate of the colour features", ge=0)
    rate_network: float = internal(1e-3, "learning rate of the network of the colours", ge=0)
    rate_decay: float = internal(
        0.1, "last over first of these rates, with exponential decay after the last halving (1)", gt=0, le=1
    )
    entropy_weight: float = internal(
        1e-4, "initial weight of the entropy of a ray's transmittance (1e-4, some scenes 1e-3)", ge=0
    )
    entropy_doublings: int = internal(
        6, "number of times that this weight doubles, evenly over the iterations", ge=0
    )
    max_entropy_weight: float = internal(0.1, "maximum weight of the entropy", ge=0)
    volume_weight: float = internal(
        1e-3, "weight of opacities times volume over voxel (1e-3, plasticine 1e-4)", ge=0
    )
    held_out: int = internal(10, "every n-th view is held out for measurement", ge=2)
    checkpoint_every: int = internal(100, "iterations between checkpoints", ge=1)

    @model_validator(mode="after")
    def _ascending(self) -> Self:
        if list(self.halvings) != sorted(set(self.halvings)) or not all(0 < f < 1 for f in self.halvings):
            raise ValueError("halvings: give ascending fractions between 0 and 1")
        return self
