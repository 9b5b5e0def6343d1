"""PLY files: vertices with any scalar properties, and triangles; `mesh` and `gaussians` say what they mean."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty, PlyParseError

from neuma_lib.errors import InputError
from neuma_lib.io.files import atomic, existing, one_line

MAX_HEADER = 2**16
"""Longest header that is read [bytes]; one of 3D Gaussian splatting takes 1.5 kB."""
TRIANGLES = ("vertex_indices", "vertex_index")
"""Names that programs give to the list of a face's corners."""


def write_ply(path: str | Path, vertices: np.ndarray, faces: np.ndarray | None = None) -> None:
    """Binary little-endian PLY from a structured vertex array and (M, 3) faces."""
    elements = [PlyElement.describe(vertices, "vertex")]
    if faces is not None:
        rows = np.empty(len(faces), dtype=[("vertex_indices", "<i4", (3,))])
        rows["vertex_indices"] = faces
        elements.append(PlyElement.describe(rows, "face"))
    with atomic(path) as partial:
        PlyData(elements, byte_order="<").write(str(partial))


def read_ply(path: str | Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Structured vertices and (M, 3) faces (None without a face element) of an ASCII or binary PLY file.

    Raises:
        InputError: no such file, no PLY file, a header that claims more than the file holds, or faces that are not
            triangles.
    """
    path = existing(path)
    try:
        with path.open("rb") as file:
            corners = _check_header(path, file.read(MAX_HEADER))
            file.seek(0)
            # A fixed length lets binary faces be read at once, not one by one.
            data = PlyData.read(file, known_list_len={"face": dict.fromkeys(corners, 3)})
            elements = {element.name: np.array(element.data) for element in data}
    except PlyParseError as error:
        if "unexpected list length" in str(error):
            raise InputError(f"{path}: only triangles are supported, face {error.row} is not one") from None
        raise InputError(f"{path} is no PLY file, or truncated or damaged ({one_line(error)})") from None
    except (ValueError, TypeError, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is no PLY file, or truncated or damaged ({one_line(error)})") from None
    if "vertex" not in elements:
        raise InputError(f"{path} has no vertices")
    if "face" not in elements:
        return elements["vertex"], None
    faces = elements["face"][corners[0]]
    if data.text:  # each face is an array of its own
        if wrong := [i for i, face in enumerate(faces) if len(face) != 3]:
            raise InputError(f"{path}: only triangles are supported, face {wrong[0]} is not one")
        faces = np.array(list(faces)).reshape(-1, 3)
    return elements["vertex"], faces.astype(np.int64)


def _check_header(path: Path, head: bytes) -> list[str]:
    """Refuse what plyfile would allocate for on the header's word; returns the face's list properties."""
    header, end, rest = head.partition(b"end_header")
    if not head.startswith(b"ply") or not end:
        raise InputError(f"{path} is not a PLY file: no header in its first {MAX_HEADER} bytes")
    if rest[:1] not in (b"\n", b"\r"):
        raise InputError(f"{path}: no new line after end_header")
    data = PlyData._parse_header(
        BytesIO(head)
    )  # plyfile, which is pinned, has no public way to read only this
    claimed, corners = 0, []
    for element in data:
        lists = [p for p in element.properties if isinstance(p, PlyListProperty)]
        if element.count < 0 or not element.properties:
            raise InputError(
                f"{path}: element {element.name} has {element.count} rows and "
                f"{len(element.properties)} properties"
            )
        if lists and (element.name != "face" or len(lists) > 1 or lists[0].name not in TRIANGLES):
            raise InputError(
                f"{path}: element {element.name} has the list {lists[-1].name}: only triangles are supported"
            )
        if element.name == "face":
            corners = [p.name for p in lists]
            if not corners:
                raise InputError(f"{path}: the faces have no list {TRIANGLES[0]}")
        for p in element.properties:
            if data.text:
                size = 2  # a digit and a separator
            elif p in lists:
                size = np.dtype(p.len_dtype).itemsize + 3 * np.dtype(p.val_dtype).itemsize
            else:
                size = np.dtype(p.val_dtype).itemsize
            claimed += element.count * size
    held = path.stat().st_size - len(header) - len(end)
    if claimed > held:
        raise InputError(
            f"{path} is truncated or damaged: its header claims {claimed} bytes, {held - 1} follow"
        )
    return corners
