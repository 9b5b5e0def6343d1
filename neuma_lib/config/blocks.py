"""Settings that live beside the code that uses them, read without importing it.

A stage with many hyper-parameters keeps them in a frozen dataclass of its own module, each explained in the docstring's
``Attributes``. `block` makes a section of the settings out of it (same names, types, defaults and explanations) from
the source text alone, so that checking the settings does not load torch.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, create_model

PACKAGE = Path(__file__).resolve().parents[1]


class Section(BaseModel):
    """A block of settings: immutable, and refuses keys that it does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)

    def plain(self) -> dict[str, Any]:
        """The section as dicts, lists and scalars, with every default filled in."""
        return self.model_dump(mode="json")


def block(module: str, name: str, base: type[Section] = Section) -> type[Section]:
    """The section of a dataclass.

    Args:
        module: where it stands, below the package, for example "fitting.gaussians".
        name: of the dataclass. Annotations may be plain types, tuples of them, unions, `Literal`, or another
            dataclass of the module, whose default is an instance.
        base: section whose fields come before.
    """
    path = PACKAGE.joinpath(*module.split(".")).with_suffix(".py")
    classes = {node.name: node for node in ast.parse(path.read_text()).body if isinstance(node, ast.ClassDef)}
    return _section(classes, name, base)


def _section(classes: dict[str, ast.ClassDef], name: str, base: type[Section]) -> type[Section]:
    documentation = ast.get_docstring(classes[name]) or ""
    explained = explanations(documentation)
    fields: dict[str, Any] = {}
    for node in classes[name].body:
        if not isinstance(node, ast.AnnAssign):
            continue
        key, annotation = node.target.id, ast.unparse(node.annotation)
        if annotation in classes:
            kind = _section(classes, annotation, Section)
            default = kind()
        else:
            kind = eval(annotation, {"Literal": Literal})
            default = ast.literal_eval(node.value)
        fields[key] = (kind, Field(default, description=explained.get(key, "")))
    summary = base.__doc__ if base is not Section else documentation.split("\n\n")[0]
    return create_model(name, __base__=base, __doc__=summary, **fields)


def explanations(documentation: str) -> dict[str, str]:
    """Name -> explanation from the ``Attributes`` of a docstring; names that share a line share the text."""
    found: dict[str, str] = {}
    names: list[str] = []
    _, _, attributes = documentation.partition("Attributes:\n")
    for line in attributes.splitlines():
        if not line.strip():
            break
        start = re.match(r" {4}(\w+(?:, \w+)*): (.*)", line)
        if start:
            names = start[1].split(", ")
            found.update(dict.fromkeys(names, start[2].strip()))
        else:
            found.update({name: f"{found[name]} {line.strip()}" for name in names})
    return {name: text.rstrip(".") for name, text in found.items()}
