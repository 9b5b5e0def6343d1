"""Analytic material laws, as scenes and priors specify them."""

from typing import Any

from pydantic import ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer

from neuma_lib.config.base import Constant, Section


class LawPart(Section):
    """One of the parts of a law: its name, and its constants in SI units by name."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Constant]

    name: str = Field(description="name of the elastic law, the return map or the viscous part")


class LawConfig(Section):
    """An analytic material: elastic law, return map, viscous part and changes along the body."""

    elasticity: LawPart = Field(description="elastic law and its constants, for example E [Pa] and nu")
    plasticity: LawPart = Field(LawPart(name="identity"), description="return map and its constants")
    field: LawPart | None = Field(
        None,
        description="factor on all stresses along the body: `ramp` to `ratio` times those of the first end, or "
        "`halves` with that ratio behind a `boundary`, a share of the length; in direction x, or of "
        "`azimuth` and `elevation` [degrees]",
    )
    viscosity: LawPart | None = Field(
        None,
        description="viscous part in shear and its constants: `kelvin_voigt` with viscosity [Pa s], or `maxwell` with "
        "modulus [Pa] and relaxation [s]",
    )

    @model_serializer(mode="wrap")
    def _without_missing_parts(self, serialise: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A law without an optional part has no such key, as in files that were written before there was one."""
        return {key: value for key, value in serialise(self).items() if value is not None}
