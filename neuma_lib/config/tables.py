"""Settings of the tables."""

from typing import Literal, Self

from pydantic import Field, model_validator

from neuma_lib.config.base import Section
from neuma_lib.config.variants import SEEDS


class TableConfig(Section):
    """Rows and columns of a table."""

    scenes: tuple[str, ...] = Field((), description="columns, in order")
    experiments: tuple[str, ...] = Field((), description="columns after the scenes, in order")
    methods: tuple[str, ...] = Field((), description="rows, in order; also variants such as neuma+rank=4")
    titles: dict[str, str] = Field({}, description="names of rows by method, if not the methods' own")
    note: str | None = Field(None, description="text below the heading of the table")
    default_target: bool = Field(
        True,
        description="whether the targets `tables` and `all` include it; false: on request by its file name",
    )
    seeds: int = Field(
        1,
        ge=1,
        description="number of replicates, `Scene`, `Scene+seed=1`, ...; several give mean and standard deviation",
    )
    vary: tuple[Literal[SEEDS], ...] = Field(
        SEEDS, min_length=1, description="what differs between replicates; the rest is shared"
    )

    @model_validator(mode="after")
    def _has_columns(self) -> Self:
        if not self.scenes and not self.experiments:
            raise ValueError("give at least one scene or experiment")
        return self
