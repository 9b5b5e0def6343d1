"""Settings of the surface mesh and the particles in it."""

from typing import Literal

from pydantic import Field

from neuma_lib.config.base import Section, internal


class SurfaceConfig(Section):
    """Reconstruction of the surface from silhouettes."""

    resolution: int = Field(96, ge=16, description="voxels along the longest side of the body")
    matte_level: float = internal(0.5, "coverage at which a pixel is half inside", gt=0, lt=1)
    smoothing: int = internal(5, "rounds of volume-preserving smoothing of the mesh (Taubin)", ge=0)


class GeometryConfig(Section):
    """Surface mesh and volume particles."""

    particles: int = Field(2000, gt=0, description="particles of the reconstructed body")
    surface: SurfaceConfig = Field(SurfaceConfig(), description="reconstruction of the surface")
    sampling: Literal["jittered", "uniform"] = Field(
        "jittered", description="particles on a jittered grid, or uniformly at random"
    )
