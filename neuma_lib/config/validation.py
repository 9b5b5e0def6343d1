"""From raw values to a section of the settings, with errors that name keys by their path."""

import difflib
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from neuma_lib.config.base import is_internal
from neuma_lib.errors import InputError

Model = TypeVar("Model", bound=BaseModel)

ADVANCED = "advanced"
"""Top-level key with the values of internal keys by path, for example ``advanced: {identify.spread: 2}``."""


def validate(kind: type[Model], raw: Any, origin: str = "") -> Model:
    """A section from raw values.

    Raises:
        InputError: names every wrong key by its path below ``origin`` and suggests close matches.
    """
    try:
        return kind.model_validate(raw)
    except ValidationError as error:
        raise joined([_explained(kind, problem, origin) for problem in error.errors()]) from None


def joined(errors: Sequence[InputError]) -> InputError:
    """One error for several problems, one line each, whose place is that of the first."""
    first, *others = errors
    if not others:
        return first
    text = str(first).removeprefix(f"{first.where}: ")
    return InputError(first.where, "\n".join([text, *map(str, others)]))


def hint(word: str, known: Iterable[str]) -> str:
    """What may be meant: the close matches of an unknown word, or all that there is."""
    known = [str(k) for k in known]
    matches = difflib.get_close_matches(str(word), known, n=2, cutoff=0.6)
    if matches:
        return f"; did you mean {' or '.join(matches)}?"
    return f"; known: {', '.join(known)}" if known else ""


def with_advanced(kind: type[BaseModel], raw: Mapping[str, Any]) -> dict[str, Any]:
    """Raw settings in which the keys of ``advanced`` are in their normal places.

    Raises:
        InputError: an internal key in its normal place, or a key of ``advanced`` that is public or unknown.
    """
    values = {key: value for key, value in raw.items() if key != ADVANCED}
    advanced = raw.get(ADVANCED) or {}
    if not isinstance(advanced, Mapping):
        raise InputError(ADVANCED, f"expected keys and values, not {advanced!r}")
    errors = [
        InputError(path, "this key is internal", f"Set it by `{ADVANCED}: {{{path}: ...}}`")
        for path in _internal_keys_in(kind, values, "")
    ]
    for path, value in advanced.items():
        entry = _entry(kind, str(path).split("."))
        if entry is None:
            errors.append(InputError(f"{ADVANCED}.{path}", f"unknown key{hint(path, _internal_paths(kind))}"))
        elif not is_internal(entry):
            errors.append(
                InputError(f"{ADVANCED}.{path}", "this key is public", f"Set {path} outside {ADVANCED}")
            )
        else:
            values = _with(values, str(path).split("."), value)
    if errors:
        raise joined(errors)
    return values


def _with(raw: Any, path: Sequence[str], value: Any) -> Any:
    """Nested dicts with another value at a path."""
    if not path:
        return value
    inner = raw if isinstance(raw, Mapping) else {}
    return {**inner, path[0]: _with(inner.get(path[0]), path[1:], value)}


def _internal_keys_in(kind: Any, raw: Any, origin: str) -> Iterator[str]:
    """Paths of the internal keys that raw values of a type set."""
    section = _section_in(kind)
    if isinstance(raw, Mapping):
        for key, value in raw.items():
            path = f"{origin}.{key}" if origin else str(key)
            entry = section.model_fields.get(key) if section else None
            if entry is not None and is_internal(entry):
                yield path
            else:
                yield from _internal_keys_in(_below(kind, key), value, path)
    elif isinstance(raw, list):
        for k, value in enumerate(raw):
            yield from _internal_keys_in(_below(kind, k), value, f"{origin}.{k}")


def _internal_paths(kind: Any, origin: str = "") -> Iterator[str]:
    """Paths of all internal keys."""
    for key, entry in kind.model_fields.items():
        inner, path = _section_in(entry.annotation), f"{origin}{key}"
        if is_internal(entry):
            yield path
        elif inner is not None:
            yield from _internal_paths(inner, f"{path}.")
        elif typing.get_origin(entry.annotation) is dict and _is_section(_below(entry.annotation, "")):
            yield from _internal_paths(_below(entry.annotation, ""), f"{path}.<name>.")


def _explained(kind: type, problem: Mapping[str, Any], origin: str) -> InputError:
    steps = [str(p) for p in problem["loc"]]
    path = ".".join([origin, *steps] if origin else steps)
    if problem["type"] == "extra_forbidden":
        return InputError(path, f"unknown key{hint(steps[-1], _keys_at(kind, problem['loc'][:-1]))}")
    if problem["type"] == "missing":
        return InputError(path, "this key is missing")
    cause = (problem.get("ctx") or {}).get("error")
    if isinstance(cause, InputError):  # of a check of several keys, which names them itself
        place = ".".join(filter(None, [path, cause.where]))
        return InputError(place, cause.problem, cause.remedy)
    message = problem["msg"].removeprefix("Value error, ")
    if not path:
        return InputError("settings", message)
    given = problem.get("input")
    return InputError(path, message + (f" (given: {given!r})" if not isinstance(given, Mapping) else ""))


def _keys_at(kind: Any, path: Sequence) -> list[str]:
    """Public keys of the section at a path."""
    section = _section_at(kind, path)
    fields = section.model_fields.items() if section else ()
    return [key for key, entry in fields if not is_internal(entry)]


def _entry(kind: Any, path: Sequence[str]) -> FieldInfo | None:
    """The field at a path; None if there is none."""
    section = _section_at(kind, path[:-1])
    return section.model_fields.get(path[-1]) if section else None


def _section_at(kind: Any, path: Sequence) -> type[BaseModel] | None:
    for step in path:
        kind = _below(kind, step)
    return _section_in(kind)


def _below(kind: Any, step: Any) -> Any:
    """Type of the values at a key of a section or mapping, or in a list; None if unknown."""
    section = _section_in(kind)
    if section is not None:
        entry = section.model_fields.get(step)
        return None if entry is None else entry.annotation
    if typing.get_origin(kind) in (dict, tuple):
        return typing.get_args(kind)[typing.get_origin(kind) is dict]
    return None


def _section_in(kind: Any) -> type[BaseModel] | None:
    """The section that a type is, or is an alternative of, for example of a section or null."""
    if _is_section(kind):
        return kind
    parts = typing.get_args(kind) if typing.get_origin(kind) in (types.UnionType, typing.Union) else ()
    return next(filter(_is_section, parts), None)


def _is_section(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)
