"""One reader and one writer for every artifact.

Writers are atomic (a temporary name in the same folder, then a rename) and deterministic: the same arrays give the
same bytes, without dates, host names or paths. Readers check what they read; a damaged or foreign file is an
`InputError` that names the file, what is wrong with it and what to do.

Lengths are metres, times seconds, masses kilograms; arrays are numpy.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from neuma_lib.errors import InputError


@contextmanager
def atomic(path: str | Path) -> Iterator[Path]:
    """A temporary path in the folder of ``path``; it takes the final name when the block ends without an error.

    A killed process leaves at most one file named ``.partial-<name>``, which the next run overwrites.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{path.name}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text."""
    with atomic(path) as partial:
        partial.write_bytes(text.encode())


def write_json(path: str | Path, data: Any) -> None:
    """Write JSON with keys in the given order. Raises ValueError on NaN or infinity."""
    write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def read_json(path: str | Path) -> Any:
    """Read JSON. Raises InputError when the file is missing or is not JSON."""
    try:
        return json.loads(existing(path).read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path} is not valid JSON ({error}): delete it and run the workflow again"
        ) from None


def existing(path: str | Path) -> Path:
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist: run the stage that makes it, or correct the path")
    return path


def sha256_file(path: str | Path) -> str:
    """Hex digest of a file's bytes."""
    return hashlib.sha256(existing(path).read_bytes()).hexdigest()
