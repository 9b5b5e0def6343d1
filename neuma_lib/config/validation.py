"""From raw values to a section of the settings, with errors that name keys by their path."""

from __future__ import annotations

import difflib
import types
import typing
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from neuma_lib.errors import InputError

Model = TypeVar("Model", bound=BaseModel)


def validate(kind: type[Model], raw: Any, origin: str = "") -> Model:
    """A section from raw values.

    Raises:
        InputError: names every offending key by its path below ``origin`` and suggests close matches.
    """
    try:
        return kind.model_validate(raw)
    except ValidationError as error:
        lines = [_explained(kind, problem, origin) for problem in error.errors()]
        raise InputError("settings: " + "\n          ".join(lines)) from None


def hint(word: str, known: Iterable[str]) -> str:
    """What may be meant: the close matches of an unknown word, or all that there is."""
    known = [str(k) for k in known]
    matches = difflib.get_close_matches(str(word), known, n=2, cutoff=0.6)
    if matches:
        return f"; did you mean {' or '.join(matches)}?"
    return f"; known: {', '.join(known)}" if known else ""


def _explained(kind: type, problem: Mapping[str, Any], origin: str) -> str:
    where = [str(p) for p in problem["loc"]]
    path = ".".join([origin, *where] if origin else where)
    if problem["type"] == "extra_forbidden":
        return f"{path}: unknown key{hint(where[-1], _keys_at(kind, problem['loc'][:-1]))}"
    if problem["type"] == "missing":
        return f"{path}: this key is missing"
    message = problem["msg"].removeprefix("Value error, ").removeprefix("settings: ")
    if not path:
        return message
    given = problem.get("input")
    return f"{path}: {message}" + (f" (given: {given!r})" if not isinstance(given, Mapping) else "")


def _keys_at(kind: Any, where: tuple) -> list[str]:
    """Keys of the section at a path."""
    for step in where:
        if _is_section(kind) and step in kind.model_fields:
            kind = kind.model_fields[step].annotation
        elif typing.get_origin(kind) in (dict, tuple):
            kind = typing.get_args(kind)[typing.get_origin(kind) is dict]
        else:
            return []
        if typing.get_origin(kind) is types.UnionType:  # of a section or null
            kind = next(filter(_is_section, typing.get_args(kind)), kind)
    return list(kind.model_fields) if _is_section(kind) else []


def _is_section(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)
