"""Methods and their variants: sets of options over the same code."""

from __future__ import annotations

import typing
from collections.abc import Mapping
from typing import Any, Literal

import yaml
from pydantic import Field, model_validator

from neuma_lib.config.base import Section
from neuma_lib.config.material import MaterialConfig
from neuma_lib.config.variants import split_variant

LAW_FROM = "law_from"
"""Key of a variant: the scene whose law is evaluated, in place of the scene's own."""


class MethodConfig(Section):
    """A method is a set of options over the same code."""

    title: str = Field(description="name in tables")
    law: Literal["learned", "true", "identified"] = Field(
        "learned",
        description="true: the scene's own law on the reconstruction, the yardstick; identified: the analytic law that "
        "the stage `identify` found in the video. Neither is trained",
    )
    note: str | None = Field(None, description="what a reader must know of its numbers; stands below tables")
    trained_as: str | None = Field(
        None, description="method whose trained law it takes, with its settings; null: its own training"
    )
    judged_on: Literal["particles", "carrier"] = Field(
        "particles",
        description="what is simulated when it is judged: the particles of the body's volume, or the carrier of its "
        "training (`material.carrier`)",
    )
    material: dict[str, Any] = Field(
        {}, description="settings of the section material that the method changes"
    )

    @model_validator(mode="after")
    def _analytic_laws_are_not_trained(self) -> MethodConfig:
        if self.law != "learned" and self.material.get("train", True):
            raise ValueError(f"law: the {self.law} law is not trained, set material: {{train: false}}")
        return self


def parse_method(text: str, methods: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Split a method's folder name, ``neuma+rank=4+seed=2``, into its base and its settings.

    Keys are those of the section ``material``, ``prior``, and ``law_from``, a scene. Values are YAML scalars; a comma
    makes a list.

    Raises:
        InputError: unknown method or key, a repeated key, or a piece without '='.
    """
    base, given = split_variant(text, methods, [*MaterialConfig.model_fields, "prior", LAW_FROM], "method")
    variant: dict[str, Any] = {}
    for key, value in given.items():
        field = MaterialConfig.model_fields.get(key)
        is_list = field is not None and typing.get_origin(field.annotation) is tuple
        variant[key] = [yaml.safe_load(v) for v in value.split(",")] if is_list else yaml.safe_load(value)
    return base, variant


def variant_title(base: str, variant: Mapping[str, Any]) -> str:
    """Name of a variant for tables, for example "NeuMA, rank 4", from the title of its base."""
    texts = {key: ",".join(map(str, v)) if isinstance(v, list) else v for key, v in variant.items()}
    return ", ".join([base, *(f"{key} {text}" for key, text in texts.items())])
