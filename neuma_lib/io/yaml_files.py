"""YAML of settings and captures. What a file expands to is bounded before anything is built of it."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, one_line, reading

MAX_BYTES = 300_000
MAX_EXPANDED = 1_000_000  # values and characters, with every alias replaced by what it names
MAX_DEPTH = 50  # deeper nesting overflows the stack of the parser in C
TOO_DEEP = f"values are nested more than {MAX_DEPTH} deep"
# characters of one value; longer integers take quadratic time, and Python does not print them
MAX_TEXT = 3_000
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the same values, several times as fast
_START = (yaml.MappingStartEvent, yaml.SequenceStartEvent)
_END = (yaml.MappingEndEvent, yaml.SequenceEndEvent)


def load_yaml(path: str | Path, remedy: str = "Give the path of an existing file") -> Any:
    """Value of a YAML file; None if it is empty.

    Args:
        remedy: what to do if the file does not exist.

    Raises:
        InputError: the file is missing or larger than `MAX_BYTES`, or see `parse_yaml`.
    """
    with open(existing(path, remedy), "rb") as file:
        return parse_yaml(file.read(MAX_BYTES + 1), path)


def parse_yaml(content: str | bytes, where: str | Path) -> Any:
    """Value of a YAML text; None if it is empty.

    Raises:
        InputError: names ``where``, line and column. The text is no YAML, repeats a key, or is too large, too deep or
            of too many aliases.
    """
    if len(content) > MAX_BYTES:
        problem = f"it is larger than {MAX_BYTES} bytes"
        raise InputError(where, problem, "Split it or remove what is not needed")
    with reading(where, "YAML"):
        try:
            _check(content, where)
            return yaml.load(content, Loader=_LOADER)
        except yaml.MarkedYAMLError as error:
            # The parser in C of some versions has its own limit, and may reach it before the first event.
            too_deep = "nesting depth" in (error.problem or "")
            raise _at(
                where, error.problem_mark, TOO_DEEP if too_deep else f"invalid YAML: {error.problem}"
            ) from None


@dataclass
class _Open:
    """A mapping or list that is being read: its anchor, size and entries so far, and the line of each of its keys."""

    anchor: str | None
    is_mapping: bool
    size: int = 1
    entries: int = 0
    keys: dict[str, int] = field(default_factory=dict)


def _check(content: str | bytes, where: str | Path) -> None:
    """Refuse repeated keys, recursion, and what is too large, from the stream of events, of which nothing is kept."""
    sizes: dict[str, int] = {}
    within = [_Open(None, False)]
    for event in yaml.parse(content, Loader=_LOADER):
        if isinstance(event, _START):
            _count_key(within[-1], None, event, where)
            sizes.pop(event.anchor, None)
            within.append(_Open(event.anchor, isinstance(event, yaml.MappingStartEvent)))
            if len(within) > MAX_DEPTH:
                raise _at(where, event.start_mark, TOO_DEEP)
            continue
        if isinstance(event, yaml.ScalarEvent):
            if len(event.value) > MAX_TEXT:
                raise _at(where, event.start_mark, f"a value has more than {MAX_TEXT} characters")
            _count_key(within[-1], event.value, event, where)
            anchor, size = event.anchor, 1 + len(event.value)
        elif isinstance(event, yaml.AliasEvent):
            if event.anchor not in sizes:
                problem = f"*{event.anchor} names nothing that is complete before it"
                raise _at(where, event.start_mark, problem)
            _count_key(within[-1], None, event, where)
            anchor, size = None, sizes[event.anchor]
        elif isinstance(event, _END):
            closed = within.pop()
            anchor, size = closed.anchor, closed.size
        else:
            continue
        if anchor:
            sizes[anchor] = size
        within[-1].size += size
        if within[-1].size > MAX_EXPANDED:
            problem = f"with its aliases (*name) it expands to more than {MAX_EXPANDED} characters"
            raise _at(where, event.start_mark, problem, "Write the values instead of aliases of aliases")


def _count_key(inside: _Open, key: str | None, event: yaml.Event, where: str | Path) -> None:
    """Count an entry of a mapping or list. Raises InputError for a second key of one name."""
    if inside.is_mapping and inside.entries % 2 == 0 and key not in (None, "<<"):
        if key in inside.keys:
            problem = f"the key '{one_line(key)}' is in line {inside.keys[key]} already"
            raise _at(where, event.start_mark, problem, "Keep one of the two")
        inside.keys[key] = event.start_mark.line + 1
    inside.entries += 1


def _at(where: str | Path, mark: yaml.Mark | None, problem: str, remedy: str = "") -> InputError:
    place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
    return InputError(where, f"{place}{one_line(problem)}", remedy)
