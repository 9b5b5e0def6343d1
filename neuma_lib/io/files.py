"""Text and JSON, checksums, and writing safely.

Writers of this package are atomic (a temporary name in the same folder, then a rename) and deterministic: the same
arrays give the same bytes, without dates, host names or paths. Readers check what they read before they allocate
memory for it; a damaged or foreign file is an `InputError` of one line that names the file, what is wrong with it and
what to do.

Lengths are metres, times seconds, masses kilograms; arrays are numpy.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

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
    """Read JSON. Raises InputError when the file is missing or is not JSON (NaN and Infinity are not)."""
    return parse_json(existing(path).read_bytes(), path)


def parse_json(content: str | bytes, where: str | Path) -> Any:
    """Value of a JSON text. Raises InputError, which names ``where``, when it is not JSON or nested too deep."""
    with reading(where, "JSON"):
        return json.loads(content, parse_constant=_refuse_constant)


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number of JSON")


@contextmanager
def reading(where: str | Path, kind: str) -> Iterator[None]:
    """Whatever the block raises becomes an `InputError` that says that ``where`` cannot be read as ``kind``.

    What reads a damaged or foreign file raises errors of many kinds. The block must only read: a full disk is no fault
    of the file.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = one_line(error) or type(error).__name__
        raise InputError(
            f"{where} cannot be read as {kind} ({reason}): replace it, or make it again"
        ) from None


def existing(path: str | Path, remedy: str = "run the stage that makes it, or correct the path") -> Path:
    """The path of a file. Raises InputError where there is none."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist: {remedy}")
    return path


def zip_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, limit: int) -> bytes:
    """Bytes of a member of an archive, at most ``limit``; neither its header nor its content can ask for more memory.

    Raises ValueError or what zipfile raises for a larger or damaged one.
    """
    # the other methods of ZIP have no bound on what a block of them unpacks to
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or info.file_size > limit:
        raise ValueError(f"{info.filename} is larger than {limit} bytes or oddly compressed")
    with archive.open(info) as file:
        return file.read(
            info.file_size + 1
        )  # read() would unpack all that is there, whatever the header claims


def sha256_file(path: str | Path) -> str:
    """Hex digest of a file's bytes."""
    return hashlib.sha256(existing(path).read_bytes()).hexdigest()


def one_line(error: object, limit: int = 200) -> str:
    """Text of an error or a value of a file, on one line and not longer than ``limit``, to quote in a message."""
    text = " ".join("".join(c if c.isprintable() else " " for c in str(error)).split())
    return text if len(text) <= limit else f"{text[:limit]}..."


def listed(files: str | Iterable[str] | None) -> list[str]:
    """Paths as a list. One path, which a workflow gives as text, is a list of one; None is empty."""
    return [files] if isinstance(files, str) else list(files or ())
