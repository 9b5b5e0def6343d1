"""Analytic material laws, as scenes and priors specify them."""

from __future__ import annotations

from pydantic import ConfigDict, Field

from neuma_lib.config.base import Constant, Section


class LawPart(Section):
    """One of the two parts of a law: its name, and its constants in SI units by name."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Constant]

    name: str = Field(description="name of the elastic law or the return map")


class LawConfig(Section):
    """An analytic material: elastic law and return map."""

    elasticity: LawPart = Field(description="elastic law and its constants, for example E [Pa] and nu")
    plasticity: LawPart = Field(LawPart(name="identity"), description="return map and its constants")
