"""What all sections of the settings have in common."""

import typing
from functools import cache
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationInfo, field_validator
from pydantic.fields import FieldInfo

Seed = Annotated[int, Field(ge=0, lt=2**31)]
Vector = tuple[float, float, float]
Compared = Literal["colour", "masks"]  # what of an image is compared


def no_boolean(value: Any) -> Any:
    """The value, in which pydantic would read true and false as the numbers 1 and 0."""
    for entry in value if isinstance(value, list | tuple) else (value,):
        if isinstance(entry, bool):
            raise ValueError(f"{str(entry).lower()} is neither a number nor a name")
        if isinstance(entry, list | tuple):
            no_boolean(entry)
    return value


Constant = Annotated[float, BeforeValidator(no_boolean)]  # a number by a name that is no field


class Section(BaseModel):
    """A section of the settings. It is immutable and rejects unknown keys, and NaN, infinity and booleans as numbers.

    Type, default, bounds and explanation of a key are those of its field. A key is public, or `internal`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _number_is_no_boolean(cls, value: Any, info: ValidationInfo) -> Any:
        return value if _admits_booleans(cls.model_fields[info.field_name].annotation) else no_boolean(value)

    def plain(self) -> dict[str, Any]:
        """The section as dicts, lists and scalars, with every default filled in; ``type(self)(**plain)`` undoes it."""
        return self.model_dump(mode="json")


def internal(default: Any, comment: str, **bounds: Any) -> Any:
    """A field that documentation and schema omit, and that YAML sets under the top-level key ``advanced`` only.

    Args:
        comment: its meaning, in one line.
        bounds: as of `pydantic.Field`.
    """
    return Field(default, description=comment, json_schema_extra={"internal": True}, **bounds)


@cache
def _admits_booleans(annotation: Any) -> bool:
    """Whether a type is a boolean, anything, or an alternative of them."""
    return annotation in (bool, Any) or any(map(_admits_booleans, typing.get_args(annotation)))


def is_internal(entry: FieldInfo) -> bool:
    """Whether a field is `internal`."""
    return bool((entry.json_schema_extra or {}).get("internal"))
