"""Presets of methods: named sets of options over the same code."""

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from neuma_lib.config.base import Section


class PresetConfig(Section):
    """A named set of options of a method. Built-in presets are part of the code of their method."""

    kind: str | None = Field(
        None, description="method, for example `neuma` or `constants`; null: that of `same_fit_as`"
    )
    title: str = Field(description="name in tables")
    note: str | None = Field(None, description="note on its numbers, printed below tables")
    same_fit_as: str | None = Field(
        None, description="preset with the fit and the options that it uses; null: its own fit"
    )
    evaluate_on: Literal["particles", "training_particles"] = Field(
        "particles",
        description="simulated particles in an evaluation: those of the body's volume, or those of the fit",
    )
    options: dict[str, Any] = Field({}, description="options of the method that differ from their defaults")

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.kind is None and self.same_fit_as is None:
            raise ValueError("kind: this key is missing")
        if self.same_fit_as and self.options:
            raise ValueError(f"options: those of '{self.same_fit_as}' apply; leave them out")
        return self
