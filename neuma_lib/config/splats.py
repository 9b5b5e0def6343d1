"""Settings of a scene whose object is a splat that was made elsewhere."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from neuma_lib.config.base import Section


class SplatConfig(Section):
    """Gaussians from a file: how they stand, which of them are the object, and how its surface is found."""

    file: str = Field(
        description="a .ply of 3D Gaussian splatting, as it is or compressed, a .splat or a .spz"
    )
    up: Literal["x", "-x", "y", "-y", "z", "-z"] = Field(
        "y", description="axis of the file that points up; photographs often give -y, Blender z"
    )
    turn: float = Field(
        0.0, description="turn about the vertical after that, counter-clockwise from above [degrees]"
    )
    min_opacity: float = Field(0.1, ge=0, lt=1, description="Gaussians at most this opaque are left out")
    max_scale: float = Field(
        0.1,
        gt=0,
        description="Gaussians with a standard deviation above this fraction of the object's longest side are left out",
    )
    reach: float = Field(
        3.0,
        gt=0,
        description="Gaussians nearer to each other than this many times the median spacing are linked, and those "
        "within two standard deviations of each other's middle axes",
    )
    min_links: int = Field(
        4, ge=0, le=16, description="Gaussians with fewer links are isolated, and left out, as is what is linked to "
        "the largest cluster by nothing"
    )  # fmt: skip
    count: int = Field(
        30000,
        ge=1,
        description="Gaussians at most: n of N are kept, evenly over space, and (N/n)^(1/3) times as large",
    )
    views: int = Field(60, ge=4, description="views around it in which its outline and depth are rendered")
    pixels: int = Field(320, ge=32, description="width and height of these views [px]")
    edge: float = Field(
        0.01,
        ge=0,
        lt=0.5,
        description="length of the edges of its surface after the repair with MeshLab, as a fraction of the longest "
        "side; 0, and without pymeshlab (`make capture`): no repair",
    )
    own_particles: bool = Field(
        False,
        description="whether Gaussians that hold no particle get one of their own, as the paper's Algorithm 1 has it; "
        "otherwise they follow the nearest ones, and small Gaussians do not make the simulation larger",
    )
