"""Repair of surfaces with MeshLab (Cignoni et al. 2008, through pymeshlab): one closed body of even triangles."""

from __future__ import annotations

import importlib.util
from types import ModuleType

import numpy as np
import trimesh

from neuma_lib.errors import InputError
from neuma_lib.extras import require
from neuma_lib.geometry.volume import check_mesh

MOST_HOLE_EDGES = 1000
"""Longest border of a hole that is closed, in edges."""
_ROUNDS = 4
"""Times that what crosses is cut out and closed again."""
_REMESHINGS = 6
"""Iterations of the remeshing."""
_WRAP = (4.0, 0.05)
"""Size of the openings that a wrapping does not enter, and its distance from the surface, in edge lengths."""

_LEAST_THICKNESS = 0.15
"""Volume over surface of what was wrapped that makes it a body, in edge lengths; a wrapped sheet has 0.05."""


def repaired(mesh: trimesh.Trimesh, edge: float, name: str = "mesh") -> trimesh.Trimesh:
    """A closed surface of one body without self-intersections, of nearly equilateral triangles (isotropic remeshing).

    Double and flat faces, faces that cross others and all bodies but the largest are removed, holes are closed, and
    faces turned outwards. What this does not mend is wrapped: the surface is then the border of the space that balls
    of four edges' radius cannot reach from outside (alpha wrapping, Portaneri et al. 2022). The volume is kept.

    Args:
        mesh: triangles [m], with holes, several bodies, any orientation.
        edge: wanted length of an edge [m].
        name: for messages.

    Raises:
        InputError: pymeshlab is missing, there are no finite faces, or no closed body is left.
    """
    meshlab()
    if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        check_mesh(mesh, name)
    for mend in (_mended, _wrapped):
        closed = mend(mesh, edge)
        even = None if closed is None else _mended(_remeshed(closed, edge), edge)
        if even is not None:
            # remeshing cuts corners; an offset along the normals restores the volume to second order
            whole = even.copy()
            whole.vertices = even.vertices + (closed.volume - even.volume) / even.area * even.vertex_normals
            return whole if _is_sound(whole) else even
    raise InputError(
        f"{name}: cannot be closed to a body with edges of {1000 * edge:.1f} mm: look at the mattes, take more"
        " photographs from all sides, or choose shorter edges (photographs.edge, of a splat splat.edge)"
    )


def has_meshlab() -> bool:
    """Whether pymeshlab is installed."""
    return importlib.util.find_spec("pymeshlab") is not None


def meshlab() -> ModuleType:
    """The module pymeshlab. Raises InputError where it is not installed."""
    return require("pymeshlab", "capture")


def crossing_faces(mesh: trimesh.Trimesh) -> int:
    """How many faces of a mesh cross others that they share no vertex or edge with."""
    meshes = _opened(mesh)
    meshes.compute_selection_by_self_intersections_per_face()
    return meshes.current_mesh().selected_face_number()


def _mended(mesh: trimesh.Trimesh, edge: float) -> trimesh.Trimesh | None:
    """Its largest body with what crosses and what is flat cut out, holes closed; None where that leaves none."""
    for attempt in range(_ROUNDS):
        meshes = _opened(mesh)
        meshes.meshing_remove_duplicate_vertices()
        meshes.meshing_remove_duplicate_faces()
        meshes.meshing_remove_null_faces()
        meshes.compute_selection_by_self_intersections_per_face()
        for _ in range(attempt):  # what was closed and crosses again is cut out more widely
            meshes.apply_selection_dilatation()
        meshes.meshing_remove_selected_faces()
        if attempt:  # a hole whose border was not to be closed gets another border
            meshes.meshing_repair_non_manifold_edges(method="Remove Faces")
            meshes.compute_selection_from_mesh_border()
            meshes.meshing_remove_selected_faces()
        body = _largest(_taken(meshes))
        mesh = None if body is None else _largest(_closed_up(_opened(body)))
        if mesh is None or _is_sound(mesh):
            return mesh
    return None


def _closed_up(meshes) -> trimesh.Trimesh:
    """With edges and vertices of two faces and one fan, and without holes as far as MeshLab can."""
    try:
        meshes.meshing_repair_non_manifold_edges(method="Remove Faces")
        meshes.meshing_repair_non_manifold_vertices()
        meshes.meshing_close_holes(maxholesize=MOST_HOLE_EDGES)
        meshes.meshing_re_orient_faces_coherently()
    except meshlab().PyMeshLabException:  # not to be closed like this
        pass
    return _taken(meshes)


def _wrapped(mesh: trimesh.Trimesh, edge: float) -> trimesh.Trimesh | None:
    meshes = _opened(mesh)
    alpha, offset = (meshlab().PureValue(part * edge) for part in _WRAP)
    meshes.generate_alpha_wrap(alpha=alpha, offset=offset)
    body = _mended(_taken(meshes), edge)
    # a sheet without an inside is wrapped from both sides
    return None if body is None or body.volume < _LEAST_THICKNESS * edge * body.area else body


def _remeshed(mesh: trimesh.Trimesh, edge: float) -> trimesh.Trimesh:
    meshes = _opened(mesh)
    meshes.meshing_isotropic_explicit_remeshing(
        iterations=_REMESHINGS, targetlen=meshlab().PureValue(edge), checksurfdist=False
    )
    return _taken(meshes)


def _largest(mesh: trimesh.Trimesh) -> trimesh.Trimesh | None:
    """The body with the most surface, turned outwards where it has an inside; None where there is no face."""
    bodies = mesh.split(only_watertight=False)
    if len(bodies) == 0:
        return None
    body = max(bodies, key=lambda part: part.area)
    if body.is_watertight and body.volume < 0:
        body.invert()
    return body


def _is_sound(mesh: trimesh.Trimesh) -> bool:
    """Whether it is one closed body, oriented outwards, and no face crosses another."""
    closed = mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0 and mesh.body_count == 1
    return bool(closed and crossing_faces(mesh) == 0)


def _opened(mesh: trimesh.Trimesh):
    """A mesh in MeshLab."""
    pymeshlab = meshlab()
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)))
    return meshes


def _taken(meshes) -> trimesh.Trimesh:
    """MeshLab's current mesh."""
    found = meshes.current_mesh()
    return trimesh.Trimesh(found.vertex_matrix(), found.face_matrix(), process=False)
