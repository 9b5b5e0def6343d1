"""Settings of tests on specimens: records of a clamped beam that is released."""

from typing import Self

from pydantic import Field, PositiveFloat, model_validator

from neuma_lib.config.base import Section, internal
from neuma_lib.config.laws import LawConfig


class SpecimenRecordConfig(Section):
    """A record of the motion of markers."""

    file: str = Field(description="CSV file in `folder`, see `neuma_lib.io.markers`")
    load: float = Field(0.0, ge=0, description="mass at the upper edge of the free end [kg]")


class SpecimenConfig(Section):
    """A beam whose law is fitted to records of its release."""

    folder: str = Field(description="folder of the records, which may be outside the project")
    records: tuple[SpecimenRecordConfig, ...] = Field(min_length=1, description="records of one beam")
    markers: tuple[str, ...] = Field(min_length=1, description="names of the markers in the files")
    along: str = Field("x", pattern="^-?[xyz]$", description="axis of the files along the beam")
    up: str = Field("y", pattern="^-?[xyz]$", description="axis of the files that points up")
    size: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = Field(
        description="free length, height and width of the beam [m]"
    )
    density: float = Field(gt=0, description="density of the material [kg/m^3]")
    root: tuple[float, float] = Field(
        description="coordinate along of the end of the clamp in the files, and its standard deviation [m]"
    )
    axis: tuple[float, float] = Field(
        description="coordinate up of the axis of the beam at the clamp, and its standard deviation [m]"
    )
    law: LawConfig = Field(description="law with guesses of its constants")
    fitted: tuple[str, ...] = Field(min_length=1, description="fitted constants of the law")
    duration: float = Field(1.0, gt=0, description="compared time after the release [s]")
    cells: tuple[int, ...] = internal((4, 6), "cells along the height, with a fit for each", min_length=1)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.along[-1] == self.up[-1]:
            raise ValueError(f"up: {self.up} is the axis along the beam as well")
        parts = self.law.plain().values()
        known = {key for part in parts for key in part} - {"name"}
        if wrong := [name for name in self.fitted if name not in known]:
            problem = f"fitted: {wrong[0]} is not a constant of the law, which has {', '.join(sorted(known))}"
            raise ValueError(problem)
        if min(self.cells) < 2:
            raise ValueError(f"cells: {min(self.cells)} along the height must be at least 2")
        return self
