"""PLY files: vertices with any scalar properties, and triangles. `mesh` and `gaussians` interpret them."""

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty

from neuma_lib.io.files import atomic, existing, reading

MAX_HEADER = 2**16  # maximum length of a header [bytes]; that of 3D Gaussian splatting has 1.5 kB
TRIANGLES = ("vertex_indices", "vertex_index")  # common names of the list of a face's corners


def write_ply(path: str | Path, vertices: np.ndarray, faces: np.ndarray | None = None) -> None:
    """Binary little-endian PLY from a structured vertex array and (M, 3) faces."""
    elements = {"vertex": vertices}
    if faces is not None:
        elements["face"] = np.empty(len(faces), dtype=[("vertex_indices", "<i4", (3,))])
        elements["face"]["vertex_indices"] = faces
    write_elements(path, elements)


def write_elements(path: str | Path, elements: Mapping[str, np.ndarray]) -> None:
    """Binary little-endian PLY from structured arrays, in the given order."""
    described = [PlyElement.describe(rows, name) for name, rows in elements.items()]
    with atomic(path) as partial:
        PlyData(described, byte_order="<").write(str(partial))


def read_ply(path: str | Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Structured vertices and (M, 3) faces (None without a face element) of an ASCII or binary PLY file.

    Raises:
        InputError: missing file, not a PLY file, a header that claims more than the file contains, or faces that are
            not triangles.
    """
    elements = read_elements(path)
    return elements["vertex"], elements.get("face")


def read_elements(path: str | Path) -> dict[str, np.ndarray]:
    """Elements of an ASCII or binary PLY file by name, as structured arrays; only the (M, 3) corners of faces.

    Raises:
        InputError: see `read_ply`.
    """
    path = existing(path)
    with reading(path, "PLY of triangles"), path.open("rb") as file:
        corners = _checked_header(file.read(MAX_HEADER), path.stat().st_size)
        file.seek(0)
        # with a known length, plyfile reads all binary faces at once
        data = PlyData.read(file, known_list_len={"face": dict.fromkeys(corners, 3)})
        elements = {element.name: np.array(element.data) for element in data}
        if "face" not in elements:
            return elements
        faces = elements["face"][corners[0]]
        if data.text:  # each face is a separate array
            if wrong := [i for i, face in enumerate(faces) if len(face) != 3]:
                raise ValueError(f"face {wrong[0]} is not a triangle")
            faces = np.array(list(faces)).reshape(-1, 3)
        return {**elements, "face": faces.astype(np.int64)}


def _checked_header(head: bytes, size: int) -> list[str]:
    """List properties of the faces. Checks that the header claims no more than a file of ``size`` bytes contains."""
    header, end, rest = head.partition(b"end_header")
    if not head.startswith(b"ply") or not end:
        raise ValueError(f"no header in its first {MAX_HEADER} bytes")
    if rest[:1] not in (b"\n", b"\r"):
        raise ValueError("no new line after end_header")
    data = PlyData._parse_header(BytesIO(head))  # plyfile has no public function for this
    if "vertex" not in data:
        raise ValueError("no vertices")
    claimed, corners = 0, []
    for element in data:
        lists = [p for p in element.properties if isinstance(p, PlyListProperty)]
        if element.count < 0 or not element.properties:
            raise ValueError(
                f"element {element.name} has {element.count} rows and {len(element.properties)} properties"
            )
        if element.name == "face":
            corners = [p.name for p in lists]
            if len(corners) != 1 or corners[0] not in TRIANGLES:
                raise ValueError(f"the faces have the lists {corners}, not {TRIANGLES[0]}")
        elif lists:
            raise ValueError(f"element {element.name} has the list {lists[0].name}")
        for p in element.properties:
            if data.text:
                claimed += 2 * element.count  # a digit and a separator
            elif p in lists:
                claimed += (
                    np.dtype(p.len_dtype).itemsize + 3 * np.dtype(p.val_dtype).itemsize
                ) * element.count
            else:
                claimed += np.dtype(p.val_dtype).itemsize * element.count
    held = size - len(header) - len(end) - 1
    if claimed > held + 1:  # the last number of an ASCII file needs no separator
        raise ValueError(f"the header claims {claimed} bytes, but {held} follow")
    return corners
