"""What all sections of the settings have in common."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from pydantic.fields import FieldInfo

Vector = tuple[float, float, float]
Compared = Literal["colour", "masks"]
"""What of an image is compared."""


class Section(BaseModel):
    """A section of the settings. It is immutable and rejects unknown keys.

    Type, default, bounds and explanation of a key are those of its field. A key is public, or `internal`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)

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


def is_internal(entry: FieldInfo) -> bool:
    """Whether a field is `internal`."""
    return bool((entry.json_schema_extra or {}).get("internal"))
