"""The PLY container: vertices with any scalar properties, and triangles. `mesh` and `gaussians` say what they mean."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neuma_lib.errors import InputError

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray | None = None) -> None:
    """Binary little-endian PLY from a structured vertex array and (M, 3) faces."""
    names = {np.dtype("<f4"): "float", np.dtype("u1"): "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property {names[vertices.dtype[name]]} {name}" for name in vertices.dtype.names]
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    with open(path, "wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode())
        file.write(vertices.tobytes())
        if faces is not None:
            rows = np.empty(len(faces), dtype=[("n", "u1"), ("v", "<i4", (3,))])
            rows["n"], rows["v"] = 3, faces
            file.write(rows.tobytes())


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Structured vertices and (M, 3) faces (None without a face element) of an ASCII or binary PLY file."""
    raw = Path(path).read_bytes()
    end = raw.find(b"end_header")
    if not raw.startswith(b"ply") or end < 0:
        raise InputError(f"{path} is not a PLY file")
    body = raw[raw.index(b"\n", end) + 1 :]
    form, elements = "", []
    for line in raw[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            form = words[1]
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            elements[-1][2].append(words[1:])
    order = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}.get(form)
    if order is None:
        raise InputError(f"{path}: unknown PLY format {form!r}")
    vertices = faces = None
    try:
        for name, count, properties in elements:
            lists = [p for p in properties if p[0] == "list"]
            if not lists:
                kind = np.dtype([(p[1], order + _TYPES[p[0]]) for p in properties])
                rows, body = _rows(body, kind, count, form)
            elif len(properties) == 1:
                kind = np.dtype(
                    [("n", order + _TYPES[lists[0][1]]), ("v", order + _TYPES[lists[0][2]], (3,))]
                )
                rows, body = _rows(body, kind, count, form)
                if count and (rows["n"] != 3).any():
                    raise InputError(
                        f"{path}: only triangles are supported, face {int(np.argmax(rows['n'] != 3))} is not"
                    )
            else:
                raise InputError(f"{path}: element {name} mixes a list with other properties")
            if name == "vertex":
                vertices = rows
            elif name == "face":
                faces = rows["v"].astype(np.int64)
    except (ValueError, KeyError, IndexError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is truncated or damaged ({error}): make it again") from None
    if vertices is None:
        raise InputError(f"{path} has no vertices")
    return vertices, faces


def _rows(body: bytes, kind: np.dtype, count: int, form: str) -> tuple[np.ndarray, bytes]:
    if form != "ascii":
        return np.frombuffer(body, kind, count), body[count * kind.itemsize :]
    lines = body.split(b"\n", count)
    if len(lines) < count:
        raise ValueError(f"{len(lines)} of {count} lines")
    rows = np.zeros(count, dtype=kind)
    flat = [tuple(map(float, line.split())) for line in lines[:count]]
    if kind.names == ("n", "v"):
        rows["n"], rows["v"] = [f[0] for f in flat], [f[1:4] for f in flat]
    else:
        for i, name in enumerate(kind.names):
            rows[name] = [f[i] for f in flat]
    return rows, lines[count] if len(lines) > count else b""
