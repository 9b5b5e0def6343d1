"""Settings of a scene whose object is a splat."""

from typing import Literal

from pydantic import Field

from neuma_lib.config.base import Section, internal


class SplatConfig(Section):
    """Gaussians from a file: orientation, selection of the object, surface."""

    file: str = Field(description="a .ply of 3D Gaussian splatting, plain or compressed, a .splat or a .spz")
    up: Literal["x", "-x", "y", "-y", "z", "-z"] = Field(
        "y", description="axis of the file that points up; often -y for photographs, z for Blender"
    )
    turn: float = Field(
        0.0, description="rotation about the vertical, counter-clockwise from above [degrees]"
    )
    min_opacity: float = internal(0.1, "opacity up to which Gaussians are omitted", ge=0, lt=1)
    max_scale: float = internal(
        0.1, "standard deviation above which Gaussians are omitted, relative to the object", gt=0
    )
    # Gaussians within two standard deviations of each other's middle axes are linked, too.
    reach: float = internal(3.0, "distance at which Gaussians are linked, in median spacings", gt=0)
    # Clusters that are not linked to the largest one are omitted, too.
    min_links: int = internal(4, "number of links below which a Gaussian is omitted", ge=0, le=16)
    count: int = Field(
        30000, ge=1, description="maximum number of Gaussians: n of N are kept, enlarged by (N/n)^(1/3)"
    )
    views: int = internal(60, "views in which silhouette and depth are rendered", ge=4)
    pixels: int = internal(320, "width and height of these views [px]", ge=32)
    # Without pymeshlab (`make capture`) there is no repair either.
    edge: float = internal(
        0.01, "edge length of the repaired surface, relative to its longest side; 0: no repair", ge=0, lt=0.5
    )
    own_particles: bool = Field(
        False,
        description="add a particle for each Gaussian that contains none (paper Algorithm 1); false: it follows the "
        "nearest particles",
    )
