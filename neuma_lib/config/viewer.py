"""Settings of the viewer."""

from pydantic import Field

from neuma_lib.config.base import Section, internal


class ViewerConfig(Section):
    """Content of `results/<scene>/viewer.html`. `neuma view` shows everything."""

    methods: tuple[str, ...] = Field(
        ("nclaw", "neuma"),
        min_length=1,
        description="methods next to the truth; on a splat, learned laws are those of the scenes `figures.i23d`",
    )
    particles: int = internal(8000, "maximum number of particles shown of each body", gt=0)
    image_side: int = internal(160, "longer side of an observed image in a frustum [px]", ge=16)
    megabytes: float = Field(25, gt=0, description="maximum size of the file [MB]; frames are omitted evenly")
