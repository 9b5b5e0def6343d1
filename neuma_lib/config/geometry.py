"""Settings of the surface mesh and of the particles in it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from neuma_lib.config.base import Section


class SurfaceConfig(Section):
    """Reconstruction of the surface from silhouettes."""

    resolution: int = Field(96, ge=16, description="voxels along the longest side of the body")
    matte_level: float = Field(0.5, gt=0, lt=1, description="coverage at which a pixel counts as half inside")
    smoothing: int = Field(
        5,
        ge=0,
        description="rounds of smoothing of the mesh, each of which moves it in and out again (Taubin), against the "
        "noise of the mattes; the volume is kept",
    )


class GeometryConfig(Section):
    """Surface mesh and volume particles."""

    particles: int = Field(2000, gt=0, description="particles of the reconstructed body")
    surface: SurfaceConfig = Field(SurfaceConfig(), description="reconstruction of the surface")
    sampling: Literal["jittered", "uniform"] = Field("jittered", description="how particles fill the volume")
