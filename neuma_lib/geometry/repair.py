"""Repair and isotropic remeshing of surfaces with MeshLab (Cignoni et al. 2008, by pymeshlab)."""

import importlib.util
from types import ModuleType

import numpy as np
import trimesh

from neuma_lib.errors import InputError
from neuma_lib.extras import require
from neuma_lib.geometry.volume import check_mesh

MAX_HOLE_EDGES = 1000  # maximum number of edges of a hole that is closed
_ROUNDS = 4  # attempts to remove self-intersections and close the holes
_REMESHINGS = 6  # iterations of the remeshing
_WRAP = (4.0, 0.05)  # alpha and offset of the alpha wrapping, in edge lengths

_MIN_THICKNESS = 0.15  # minimum volume over area of a wrapped body, in edge lengths; a wrapped sheet has 0.05


def repaired(mesh: trimesh.Trimesh, edge: float, name: str = "mesh") -> trimesh.Trimesh:
    """A closed surface of one body without self-intersections, of nearly equilateral triangles (isotropic remeshing).

    Removes duplicate, degenerate and self-intersecting faces and all bodies but the largest, closes holes, and orients
    faces outwards. If this fails, the surface is replaced by its alpha wrapping (Portaneri et al. 2022), the border of
    the space that balls with a radius of four edges cannot reach from outside. The volume is preserved.

    Args:
        mesh: triangles [m]; may have holes, several bodies and any orientation.
        edge: target length of an edge [m].

    Raises:
        InputError: pymeshlab is missing, there are no finite faces, or no closed body is left.
    """
    meshlab()
    if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        check_mesh(mesh, name)
    for repair in (_mended, _wrapped):
        closed = repair(mesh, edge)
        even = None if closed is None else _mended(_remeshed(closed, edge), edge)
        if even is not None:
            # remeshing shrinks the body; an offset along the normals restores the volume to second order
            whole = even.copy()
            whole.vertices = even.vertices + (closed.volume - even.volume) / even.area * even.vertex_normals
            return whole if _is_sound(whole) else even
    raise InputError(
        name,
        f"cannot be closed to a body with edges of {1000 * edge:.1f} mm",
        "Check the mattes, take more photographs from all sides, or reduce photographs.edge (splat.edge for a splat)",
    )


def has_meshlab() -> bool:
    """Whether pymeshlab is installed."""
    return importlib.util.find_spec("pymeshlab") is not None


def meshlab() -> ModuleType:
    """The module pymeshlab. Raises InputError where it is not installed."""
    return require("pymeshlab", "capture")


def crossing_faces(mesh: trimesh.Trimesh) -> int:
    """Number of faces of a mesh that intersect faces without a common vertex or edge."""
    meshes = to_meshlab(mesh)
    meshes.compute_selection_by_self_intersections_per_face()
    return meshes.current_mesh().selected_face_number()


def _mended(mesh: trimesh.Trimesh, edge: float) -> trimesh.Trimesh | None:
    """The largest body without intersecting or degenerate faces and with closed holes; None if this fails."""
    for attempt in range(_ROUNDS):
        meshes = to_meshlab(mesh)
        meshes.meshing_remove_duplicate_vertices()
        meshes.meshing_remove_duplicate_faces()
        meshes.meshing_remove_null_faces()
        meshes.compute_selection_by_self_intersections_per_face()
        for _ in range(attempt):  # each attempt removes a wider neighbourhood
            meshes.apply_selection_dilatation()
        meshes.meshing_remove_selected_faces()
        if attempt:  # change the border of holes that could not be closed
            meshes.meshing_repair_non_manifold_edges(method="Remove Faces")
            meshes.compute_selection_from_mesh_border()
            meshes.meshing_remove_selected_faces()
        body = _largest(from_meshlab(meshes))
        mesh = None if body is None else _largest(_closed_up(to_meshlab(body)))
        if mesh is None or _is_sound(mesh):
            return mesh
    return None


def _closed_up(meshes) -> trimesh.Trimesh:
    """The mesh as a manifold, with holes closed as far as MeshLab can."""
    try:
        meshes.meshing_repair_non_manifold_edges(method="Remove Faces")
        meshes.meshing_repair_non_manifold_vertices()
        meshes.meshing_close_holes(maxholesize=MAX_HOLE_EDGES)
        meshes.meshing_re_orient_faces_coherently()
    except meshlab().PyMeshLabException:  # the caller checks the result
        pass
    return from_meshlab(meshes)


def _wrapped(mesh: trimesh.Trimesh, edge: float) -> trimesh.Trimesh | None:
    meshes = to_meshlab(mesh)
    alpha, offset = (meshlab().PureValue(part * edge) for part in _WRAP)
    meshes.generate_alpha_wrap(alpha=alpha, offset=offset)
    body = _mended(from_meshlab(meshes), edge)
    # a sheet is wrapped from both sides to a thin body
    return None if body is None or body.volume < _MIN_THICKNESS * edge * body.area else body


def _remeshed(mesh: trimesh.Trimesh, edge: float) -> trimesh.Trimesh:
    meshes = to_meshlab(mesh)
    meshes.meshing_isotropic_explicit_remeshing(
        iterations=_REMESHINGS, targetlen=meshlab().PureValue(edge), checksurfdist=False
    )
    return from_meshlab(meshes)


def _largest(mesh: trimesh.Trimesh) -> trimesh.Trimesh | None:
    """The body with the largest area, oriented outwards if closed; None if there are no faces."""
    bodies = mesh.split(only_watertight=False)
    if len(bodies) == 0:
        return None
    body = max(bodies, key=lambda part: part.area)
    if body.is_watertight and body.volume < 0:
        body.invert()
    return body


def _is_sound(mesh: trimesh.Trimesh) -> bool:
    """Whether a mesh is one closed body, oriented outwards, without self-intersections."""
    closed = mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0 and mesh.body_count == 1
    return bool(closed and crossing_faces(mesh) == 0)


def to_meshlab(mesh: trimesh.Trimesh):
    """A MeshLab document with the mesh."""
    pymeshlab = meshlab()
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)))
    return meshes


def from_meshlab(meshes) -> trimesh.Trimesh:
    """MeshLab's current mesh."""
    mesh = meshes.current_mesh()
    return trimesh.Trimesh(mesh.vertex_matrix(), mesh.face_matrix(), process=False)
