"""Settings of the viewer."""

from __future__ import annotations

from pydantic import Field

from neuma_lib.config.base import Section


class ViewerConfig(Section):
    """Content of the file `results/<scene>/viewer.html`. `neuma view` shows everything."""

    methods: tuple[str, ...] = Field(
        ("nclaw", "neuma"),
        min_length=1,
        description="methods or variants in the file, beside the truth; on a splat, one that learns stands for its "
        "laws of the scenes `figures.i23d`",
    )
    particles: int = Field(
        8000, gt=0, description="most particles of each that are shown; others are left out"
    )
    image_side: int = Field(160, ge=16, description="longer side of an observed image in a frustum [px]")
    megabytes: float = Field(
        25,
        gt=0,
        description="largest size of the file [MB]; where it is too small, frames are left out evenly",
    )
