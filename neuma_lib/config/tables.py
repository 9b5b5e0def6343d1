"""Settings of the tables."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from neuma_lib.config.base import Section
from neuma_lib.config.variants import DRAWN


class TableConfig(Section):
    """Rows and columns of a table of the paper."""

    scenes: tuple[str, ...] = Field((), description="columns, in order")
    experiments: tuple[str, ...] = Field((), description="columns after the scenes, in order")
    methods: tuple[str, ...] = Field((), description="rows, in order; variants such as neuma+rank=4 too")
    titles: dict[str, str] = Field({}, description="names of rows other than the methods' own, by method")
    note: str | None = Field(None, description="what a reader must know of the whole table; stands below it")
    default_target: bool = Field(
        True,
        description="whether the targets `tables` and `all` include it; false: on request by its file name",
    )
    seeds: int = Field(
        1,
        ge=1,
        description="chains behind every number, in the folders `Scene`, `Scene+seed=1`, ...; with several, mean and "
        "standard deviation are shown",
    )
    vary: tuple[Literal[DRAWN], ...] = Field(
        DRAWN, min_length=1, description="what the chains draw anew; what they share is computed once"
    )

    @model_validator(mode="after")
    def _has_columns(self) -> TableConfig:
        if not self.scenes and not self.experiments:
            raise ValueError("give at least one scene or experiment, a column each")
        return self
