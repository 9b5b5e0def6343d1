"""Triangle meshes as PLY."""

from pathlib import Path

import numpy as np
import trimesh

from neuma_lib.errors import InputError
from neuma_lib.io.files import reading
from neuma_lib.io.hdf5 import check_indices
from neuma_lib.io.ply import read_ply, write_ply


def write_mesh(path: str | Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write a triangle mesh: vertices (N, 3) [m], faces (M, 3)."""
    rows = np.empty(len(vertices), dtype=[(axis, "<f4") for axis in "xyz"])
    for i, axis in enumerate("xyz"):
        rows[axis] = vertices[:, i]
    write_ply(path, rows, faces)


def read_mesh(path: str | Path, watertight: bool = True) -> trimesh.Trimesh:
    """Read a triangle mesh in metres.

    Raises:
        InputError: missing properties, values that are not finite, or holes if ``watertight`` is required.
    """
    rows, faces = read_ply(path)
    missing = [axis for axis in "xyz" if axis not in rows.dtype.names]
    if missing or faces is None or len(faces) == 0:
        raise InputError(path, f"is not a triangle mesh: it has no {', '.join(missing) or 'faces'}")
    vertices = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
    if (bad := ~np.isfinite(vertices).all(axis=1)).any():
        raise InputError(path, f"vertex {np.argmax(bad)} of {len(bad)} is not finite", "Rebuild the mesh")
    with reading(path, "a triangle mesh"):
        check_indices("faces", faces, len(vertices))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if watertight and not mesh.is_watertight:
        raise InputError(path, "is not watertight", "Close its holes with a mesh repair tool")
    if watertight and mesh.volume <= 0:
        raise InputError(path, f"has a volume of {mesh.volume:.3g} m^3: its faces point inwards", "Flip them")
    return mesh
