"""Methods and their variants: sets of options over the same code."""

from __future__ import annotations

import typing
from collections.abc import Mapping
from typing import Any, Literal

import yaml
from pydantic import Field, model_validator

from neuma_lib.config.base import Section
from neuma_lib.config.material import MaterialConfig
from neuma_lib.config.pac_nerf import PacNerfConfig
from neuma_lib.config.springs import SpringsConfig
from neuma_lib.config.structured import StructuredConfig
from neuma_lib.config.variants import split_variant

LAW_FROM = "law_from"
"""Key of a variant: the scene whose law is evaluated, in place of the scene's own."""
IDENTIFIED = "identified"
"""Name of the prior, or of the law, that the stage `identify` found in the scene's own video."""


class MethodConfig(Section):
    """A method is a set of options over the same code."""

    title: str = Field(description="name in tables")
    law: Literal["learned", "structured", "true", "identified", "springs", "pac_nerf"] = Field(
        "learned",
        description="learned: the paper's networks; structured: a correction of the prior's analytic law that keeps "
        "the structure of a material; true: the scene's own law on the reconstruction, the yardstick; identified: the "
        "analytic law that the stage `identify` found in the video. The last two are not trained. springs: no law of a "
        "material, but a network of springs in the body (Spring-Gaus). pac_nerf: the analytic law, and the throw, that "
        "PAC-NeRF found in the video; its settings are those of the section pac_nerf",
    )
    prior: str | None = Field(
        None,
        description="prior that it starts from: one of priors.laws, or `identified`, the law that was found in the "
        "video; null: the scene's",
    )
    note: str | None = Field(None, description="what a reader must know of its numbers; stands below tables")
    trained_as: str | None = Field(
        None, description="method whose trained law it takes, with its settings; null: its own training"
    )
    judged_on: Literal["particles", "carrier"] = Field(
        "particles",
        description="what is simulated when it is judged: the particles of the body's volume, or the carrier of its "
        "training: that of `material.carrier`, and with PAC-NeRF's law the particles of its field, which then also "
        "carries the pictures",
    )
    material: dict[str, Any] = Field(
        {}, description="settings of the section material that the method changes"
    )
    structured: dict[str, Any] = Field(
        {}, description="settings of the section structured that a method with a structured law changes"
    )
    springs: dict[str, Any] = Field(
        {}, description="settings of the section springs that a method with springs changes"
    )
    pac_nerf: dict[str, Any] = Field(
        {}, description="settings of the section pac_nerf that a method with PAC-NeRF's law changes"
    )

    @model_validator(mode="after")
    def _fits_its_law(self) -> MethodConfig:
        trained = self.law in ("learned", "structured", "springs")
        if not trained and self.material.get("train", True):
            raise ValueError(f"law: the {self.law} law is not trained, set material: {{train: false}}")
        if (not trained or self.law == "springs") and self.prior is not None:
            raise ValueError(f"prior: the {self.law} law has none, leave it out")
        if self.law == "structured" and not self.material.get("train", True):
            raise ValueError(
                "law: a structured law without training is its analytic law, choose law: identified"
            )
        for section in ("structured", "springs", "pac_nerf"):
            if self.law != section and getattr(self, section):
                raise ValueError(f"{section}: only a method with law: {section} has these settings")
        return self


def parse_method(text: str, methods: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Split a method's folder name, ``neuma+rank=4+seed=2``, into its base and its settings.

    Keys are those of the sections ``material``, ``structured``, ``springs`` and ``pac_nerf``, ``prior``, and
    ``law_from``, a scene.
    Values are YAML scalars; a comma makes a list.

    Raises:
        InputError: unknown method or key, a repeated key, or a piece without '='.
    """
    sections = (MaterialConfig, StructuredConfig, SpringsConfig, PacNerfConfig)
    keys = [*(key for section in sections for key in section.model_fields), "prior", LAW_FROM]
    base, given = split_variant(text, methods, keys, "method")
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
