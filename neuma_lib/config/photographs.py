"""Settings of the static reconstruction where it is made from photographs.

They count where a transforms.json has the entry ``photographs``. Captures write it; it can be added to image sets from
elsewhere: ``"photographs": {"floor": 0.0}``, with the height y of the floor that the object lies on [m], or null.
"""

from __future__ import annotations

from pydantic import Field

from neuma_lib.config.base import Section


class PhotographsConfig(Section):
    """Where a transforms.json has the entry `photographs`, as those of captures have: other sizes and exposures."""

    margin: float = Field(
        0.1,
        ge=0,
        description="what is kept around a mask, as a fraction of the longer side of its bounding box",
    )
    longest: int = Field(
        400,
        ge=32,
        description="longer side of what is kept of a photograph, reduced to it where it is larger [px]",
    )
    agreement: float = Field(
        0.9,
        gt=0.5,
        le=1,
        description="share of the masks that must hold a point of the body that the masks are judged by",
    )
    lacking: float = Field(
        0.1,
        gt=0,
        le=1,
        description="share of that body that a mask may lack; photographs with other masks are left out, since the "
        "surface is what all masks hold; 1: none is left out",
    )
    gain_rate: float = Field(
        0.01,
        ge=0,
        description="learning rate of the logarithm of each photograph's exposure, one for red, green and blue; falls "
        "to a tenth; 0: exposure and white balance are taken to be alike",
    )
    edge: float = Field(
        0.03,
        gt=0,
        le=0.2,
        description="length of the edges of the repaired surface, as a fraction of the body's longest side",
    )
