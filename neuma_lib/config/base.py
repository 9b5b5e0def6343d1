"""What all sections of the settings have in common."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

Vector = tuple[float, float, float]
Compared = Literal["colour", "masks"]
"""What of an image is compared."""


class Section(BaseModel):
    """A section of the settings: immutable, and refuses keys that it does not know.

    A key has one home: its type, default, bounds and explanation are those of its field.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)

    def plain(self) -> dict[str, Any]:
        """The section as dicts, lists and scalars, with every default filled in; ``type(self)(**plain)`` undoes it."""
        return self.model_dump(mode="json")
