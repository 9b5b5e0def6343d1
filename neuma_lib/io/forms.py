"""Expected entries of the JSON files of stages, and objects that name their file if an entry is missing."""

from pathlib import Path
from typing import Any

from neuma_lib.errors import InputError

_REMEDY = "Restore the file, or regenerate it"


class JsonObject(dict):
    """Object of a JSON file. A missing key raises an `InputError` that names the file and the key."""

    where = "JSON"

    def __missing__(self, key: str):
        raise InputError(self.where, f"has no entry '{key}'", _REMEDY)

    @classmethod
    def of(cls, pairs: list[tuple[str, Any]], where: str) -> "JsonObject":
        """From the entries of an object, of which no two may have one key."""
        made = cls(pairs)
        if len(made) < len(pairs):
            seen: set[str] = set()
            twice = next(key for key, _ in pairs if key in seen or seen.add(key))
            raise ValueError(f"the key '{twice}' occurs twice in an object")
        made.where = where
        return made


_VECTOR = [float] * 3
_MOTION = {
    **dict.fromkeys(("v0", "angular_velocity"), _VECTOR),
    "without_ridge": {"v0": _VECTOR},
    **dict.fromkeys(("std_camera", "angular_velocity_std_camera"), _VECTOR),
    "centre": (_VECTOR, None),
    "camera_axes": [_VECTOR] * 3,
    "frames": [int],
    "particles": int,
}
_QUANTITIES = {"*": {"value": (float, None), "log_std": (float, None)}}
_FIT = {"law": {"*": {"*": (float, str)}}, "constants": _QUANTITIES, "quantities": _QUANTITIES}
FORMS: dict[str, Any] = {
    "velocity.json": {**_MOTION, "bodies": [_MOTION]},
    "identified.json": {
        **_FIT, "best": _FIT, "material": _FIT, "families": {"*": _FIT},
        "start": _MOTION, "grid": int, "family": str, "ties": [str], "compared": [str],
    },
    "constants.json": _FIT,
    **dict.fromkeys(("metrics.json", "gaussians.json", "history.json"), {}),
}  # fmt: skip
"""Name of a file -> form of its content. Other files are checked where they are interpreted.

A type; None; a list of several forms of its items, or of one for all; a dict of forms of the entries that an object
may have, "*" for all; a tuple of alternatives.
"""
_NAMES = {float: "a number", int: "an integer", str: "a text", None: "null"}


def check_form(path: str | Path, content: Any) -> None:
    """Raise an `InputError` that names file and key if an entry has another type than in `FORMS`."""
    if (form := FORMS.get(Path(path).name)) is not None and (wrong := _wrong(content, form, "")):
        key, expected = wrong
        raise InputError(f"{path}: {key}" if key else path, f"must be {expected}", _REMEDY)


def _wrong(value: Any, form: Any, key: str) -> tuple[str, str] | None:
    """The key of the first part that has another form, and the expected one."""
    if isinstance(form, tuple):
        results = [_wrong(value, each, key) for each in form]
        return (
            None if None in results else (key, " or ".join(expected for _, expected in results if expected))
        )
    if isinstance(form, dict):
        if not isinstance(value, dict):
            return key, "an object"
        parts = [(value[name], form.get(name, form.get("*")), f"{key}.{name}") for name in value]
        parts = [part for part in parts if part[1] is not None]
    elif isinstance(form, list):
        if not isinstance(value, list) or (len(form) > 1 and len(value) != len(form)):
            return key, f"a list of {len(form)}" if len(form) > 1 else "a list"
        parts = [(item, form[i % len(form)], f"{key}[{i}]") for i, item in enumerate(value)]
    else:
        kinds = {float: (int, float), None: (type(None),)}.get(form, (form,))
        return None if type(value) in kinds else (key, _NAMES[form])
    return next((wrong for part in parts if (wrong := _wrong(part[0], part[1], part[2].lstrip(".")))), None)
