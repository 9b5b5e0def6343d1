"""Analytic material laws, as they are specified in scenes and priors."""

from __future__ import annotations

from pydantic import ConfigDict, Field

from neuma_lib.config.base import Section


class LawPart(Section):
    """One of the two parts of a law: its name, and its constants in SI units by name."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, float]

    name: str = Field(description="name of the elastic law or the return map")


class LawConfig(Section):
    """An analytic material: two named laws with their constants in SI units."""

    elasticity: LawPart = Field(
        description="name and constants of the elastic law, for example E [Pa] and nu"
    )
    plasticity: LawPart = Field(LawPart(name="identity"), description="name and constants of the return map")
