"""Text and JSON, checksums and atomic writing.

Writers of this package are atomic (a temporary name in the same folder, then a rename) and deterministic: equal arrays
give equal bytes, without dates, host names or paths. Readers check sizes before they allocate memory, and raise an
`InputError` of one line for a damaged or foreign file.

Lengths are metres, times seconds, masses kilograms; arrays are numpy.
"""

import errno
import hashlib
import json
import math
import os
import re
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from neuma_lib.errors import InputError
from neuma_lib.io.forms import JsonObject, check_form


@contextmanager
def atomic(path: str | Path) -> Iterator[Path]:
    """A temporary path in the folder of ``path``, renamed to ``path`` when the block ends without an error.

    A killed process leaves at most one file ``.partial-<name>``, which the next run overwrites.

    Raises:
        InputError: the disk is full or the folder is read-only.
    """
    path = Path(path)
    partial = path.with_name(f".partial-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        os.replace(partial, path)
    except (OSError, RuntimeError) as error:
        if full := unwritable(error, path):
            raise full from None
        raise
    finally:
        with suppress(OSError):  # of a read-only file system, even if there is no such file
            partial.unlink(missing_ok=True)


_FULL = "Free disk space and run the same command again"
_READ_ONLY = "Make the folder writable, or choose another one (setting results_root or data_root)"
_REMEDIES = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), _FULL),
    **dict.fromkeys((errno.EROFS, errno.EACCES, errno.EPERM), _READ_ONLY),
}


def unwritable(error: BaseException, path: str | Path | None = None) -> InputError | None:
    """The error of a full disk or of a read-only folder as an `InputError`; None for other errors.

    Args:
        path: the file that was written, if the error does not name it.
    """
    match = re.search(r"errno = (\d+)", str(error))  # HDF5 raises a RuntimeError
    number = int(match[1]) if match else getattr(error, "errno", None)
    if number not in _REMEDIES:
        return None
    where = path or getattr(error, "filename", None) or "output"
    return InputError(where, f"cannot be written: {os.strerror(number)}", _REMEDIES[number])


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text."""
    with atomic(path) as partial:
        partial.write_bytes(text.encode())


def write_json(path: str | Path, data: Any) -> None:
    """Write JSON with keys in the given order. Raises ValueError on NaN or infinity."""
    write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def read_json(path: str | Path) -> Any:
    """Read JSON. Raises InputError if the file is missing, is not JSON, or has entries of other types than its form.

    A missing entry raises InputError where it is used.
    """
    content = parse_json(existing(path).read_bytes(), path)
    check_form(path, content)
    return content


def parse_json(content: str | bytes, where: str | Path) -> Any:
    """Value of a JSON text, with objects as `JsonObject`.

    Raises:
        InputError: names ``where``. Not JSON, nested too deeply, a repeated key, or a number that is not finite.
    """
    with reading(where, "JSON"):
        return json.loads(
            content,
            parse_constant=_finite,
            parse_float=_finite,
            parse_int=_int64,
            object_pairs_hook=lambda pairs: JsonObject.of(pairs, str(where)),
        )


def _int64(text: str) -> int:
    """An integer that numpy can hold."""
    if len(text) > 20 or not -(2**63) <= int(text) < 2**63:
        raise ValueError(f"{one_line(text, 30)} is too large an integer")
    return int(text)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not valid JSON")
    return value


@contextmanager
def reading(where: str | Path, kind: str) -> Iterator[None]:
    """Turn any exception of the block into an `InputError`: ``where`` cannot be read as ``kind``.

    The block must only read, because an error of writing is not the fault of the file.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = one_line(error) or type(error).__name__
        raise InputError(where, f"cannot be read as {kind}: {reason}", "Replace or regenerate it") from None


def located(error: InputError, path: str | Path) -> InputError:
    """The error of a part of a file, with the file added to its place."""
    return InputError(f"{path}: {one_line(error.where)}", one_line(error.problem, 600), error.remedy)


def existing(path: str | Path, remedy: str = "Run the stage that writes it, or correct the path") -> Path:
    """The path of a file. Raises InputError if it does not exist."""
    path = Path(path)
    if not path.is_file():
        if path.exists():
            raise InputError(path, "is not a regular file", remedy)
        raise InputError(path, "does not exist", remedy)
    return path


def read_regular(path: str | Path) -> bytes:
    """Content of a regular file of at most 2^28 bytes. Raises InputError for others, which may never end."""
    path = existing(path, "Put the file there, or correct its name")
    if path.stat().st_size > 2**28:
        raise InputError(path, f"is larger than {2**28} bytes", "Replace it by a smaller file")
    return path.read_bytes()


def zip_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, limit: int) -> bytes:
    """Bytes of a member of an archive. Neither its header nor its content can make it use more than ``limit`` bytes.

    Raises ValueError, or an error of zipfile, for a larger or damaged member.
    """
    # other compression methods have no bound on the size of an unpacked block
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or info.file_size > limit:
        raise ValueError(f"{info.filename} is larger than {limit} bytes or has an unsupported compression")
    with archive.open(info) as file:
        return file.read(info.file_size + 1)  # read() would unpack everything, whatever the header claims


def sha256_file(path: str | Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    return hashlib.sha256(existing(path).read_bytes()).hexdigest()


def one_line(error: object, limit: int = 200) -> str:
    """Text of an error or of a value in a file, on one line of at most ``limit`` characters, for messages."""
    text = " ".join("".join(c if c.isprintable() else " " for c in str(error)).split())
    return text if len(text) <= limit else f"{text[:limit]}..."


def listed(files: str | Iterable[str] | None) -> list[str]:
    """Paths as a list. One path, which a workflow gives as text, is a list of one; None is empty."""
    return [files] if isinstance(files, str) else list(files or ())
