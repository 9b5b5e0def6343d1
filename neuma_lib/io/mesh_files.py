"""Mesh files of other programs: OBJ, PLY, STL and GLB."""

from io import BytesIO
from pathlib import Path

import numpy as np
import trimesh

from neuma_lib.config.obstacles import MESH_SUFFIXES
from neuma_lib.errors import InputError
from neuma_lib.io.child import arrays_from_child
from neuma_lib.io.files import existing

MAX_MESH_BYTES = 32 * 2**20  # maximum size of a mesh file of another program
MAX_FACES = 500_000  # maximum number of its triangles
_SIMPLIFY = "Simplify the mesh, for example with Blender's modifier Decimate"


def read_any_mesh(path: str | Path) -> trimesh.Trimesh:
    """Read the triangles of an OBJ, PLY, STL or GLB file, all objects together, in the units of the file.

    The mesh may have holes, several bodies and any orientation. The file is read in a child process with little memory.

    Raises:
        InputError: missing, another format, too large or damaged, or without faces or extent.
    """
    path = existing(path, "Correct the path, which is relative to the project's folder")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise InputError(path, "is not a mesh file", f"Export it as one of {', '.join(MESH_SUFFIXES)}")
    if path.stat().st_size > MAX_MESH_BYTES:
        problem = (
            f"has {path.stat().st_size / 2**20:.0f} MiB, and at most {MAX_MESH_BYTES / 2**20:.0f} are read"
        )
        raise InputError(path, problem, _SIMPLIFY)
    arrays = arrays_from_child("neuma_lib.io.mesh_files:parse_any_mesh", path, "a triangle mesh")
    mesh = trimesh.Trimesh(arrays["vertices"], arrays["faces"], process=False)
    if len(mesh.faces) == 0 or len(mesh.faces) > MAX_FACES:
        problem = f"has {len(mesh.faces)} faces, expected 1 to {MAX_FACES}"
        raise InputError(path, problem, _SIMPLIFY if len(mesh.faces) else "Export a mesh with triangles")
    corners = mesh.vertices[np.unique(mesh.faces)]
    if not (np.isfinite(corners).all() and 0 < float(np.ptp(corners, axis=0).max()) < 1e12):
        raise InputError(path, "has coordinates that are not finite, or no extent", "Export the mesh again")
    return mesh


def parse_any_mesh(path: str) -> dict[str, np.ndarray]:
    """Vertices (N, 3) and faces (M, 3) of a mesh file. Without a limit of memory: use `read_any_mesh`."""
    content = BytesIO(Path(path).read_bytes())  # and not the path, so that the reader opens no other files
    kind = Path(path).suffix.lower().removeprefix(".")
    mesh = trimesh.load(content, file_type=kind, force="mesh", process=False, skip_materials=True)
    faces = np.asarray(mesh.faces)[: MAX_FACES + 1].reshape(-1, 3)
    vertices = np.asarray(mesh.vertices, np.float64).reshape(-1, 3)
    if len(faces) and not (faces.min() >= 0 and faces.max() < len(vertices)):
        raise ValueError("a face refers to a vertex that does not exist")
    return {"vertices": vertices, "faces": faces.astype(np.int64)}
