"""Repair and isotropic remeshing of surfaces with MeshLab (Cignoni et al. 2008, by pymeshlab)."""

from __future__ import annotations

import importlib.util
from types import ModuleType

import numpy as np
import trimesh

from neuma_lib.errors import InputError
from neuma_lib.extras import require
from neuma_lib.geometry.shapes import Shape, meshed
from neuma_lib.geometry.volume import check_mesh, signed_distance

MAX_HOLE_EDGES = 1000
"""Maximum number of edges of a hole that is closed."""
_ROUNDS = 4
"""Attempts to remove self-intersections and close the holes."""
_REMESHINGS = 6
"""Iterations of the remeshing."""
_WRAP = (4.0, 0.05)
"""Alpha and offset of the alpha wrapping, in edge lengths."""

_MIN_THICKNESS = 0.15
"""Minimum volume over area of a wrapped body, in edge lengths; a wrapped sheet has 0.05."""
_MAX_AREA = 100
"""Maximum area of a mesh whose longest side is 1. Its distances take a minute; a cube has 6."""
_REMESH = (
    "Close its holes and give its walls a thickness, for example with Blender's modifiers Solidify and Remesh"
)


def repaired(mesh: trimesh.Trimesh, edge: float, name: str = "mesh") -> trimesh.Trimesh:
    """A closed surface of one body without self-intersections, of nearly equilateral triangles (isotropic remeshing).

    Removes duplicate, degenerate and self-intersecting faces and all bodies but the largest, closes holes, and orients
    faces outwards. If this fails, the surface is replaced by its alpha wrapping (Portaneri et al. 2022), the border of
    the space that balls with a radius of four edges cannot reach from outside. The volume is preserved.

    Args:
        mesh: triangles [m]; may have holes, several bodies and any orientation.
        edge: target length of an edge [m].
        name: for messages.

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


def solid_body(
    mesh: trimesh.Trimesh, name: str = "mesh", resolution: int = 96
) -> tuple[trimesh.Trimesh, list[str]]:
    """The largest solid body in a mesh of any quality, meshed evenly as `neuma_lib.geometry.shapes.build` does.

    MeshLab removes duplicate, degenerate and excess faces, closes holes and orients faces coherently, if the mesh is
    not closed. The inside is then where the winding number exceeds 1/2, so overlapping parts are one body. Cavities are
    filled. Parts thinner than a cell are lost.

    Args:
        mesh: triangles in any unit.
        name: for messages.
        resolution: cells along the longest side.

    Returns:
        Closed mesh, oriented outwards, its bounding box centred at the origin, in the same unit; and what was done, in
        words.

    Raises:
        InputError: pymeshlab is missing and the mesh is not closed, or it encloses nothing.
    """
    scale = float(mesh.extents.max())
    mesh = trimesh.Trimesh((mesh.vertices - mesh.bounds.mean(axis=0)) / scale, mesh.faces, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    done: list[str] = []
    if not (mesh.is_watertight and mesh.is_winding_consistent):
        mesh = _closed_by_meshlab(mesh, done)
    if mesh.area > _MAX_AREA:
        problem = f"has {mesh.area:.0f} times the area of its longest side squared, at most {_MAX_AREA} are possible"
        raise InputError(name, problem, "Remove inner and overlapping faces")
    part = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    a, b, c = mesh.triangles.transpose(1, 0, 2)
    inward = np.bincount(part, np.einsum("ij,ij->i", a, np.cross(b, c))) < 0
    if inward.any():
        done.append(f"turned the faces of {inward.sum()} of {len(inward)} parts outwards")
        mesh = trimesh.Trimesh(
            mesh.vertices, np.where(inward[part][:, None], mesh.faces[:, ::-1], mesh.faces), process=False
        )
    solid = Shape({"body": lambda points: signed_distance(mesh, points)}, 0.0, *mesh.bounds.tolist())
    try:
        bodies = meshed(solid, resolution)
    except ValueError:  # of marching cubes: no point of the grid is inside
        problem = f"encloses no space that is wider than 1/{resolution} of its longest side"
        raise InputError(name, problem, _REMESH) from None
    body = max(bodies, key=lambda part: part.volume)
    outer = [part.volume for part in bodies if part.volume > 0]
    if len(outer) > 1:
        done.append(
            f"removed all bodies but the largest, which has {body.volume / sum(outer):.1%} of the volume"
        )
    if len(outer) < len(bodies):
        done.append("filled cavities")
    done.append(f"meshed with cells of 1/{resolution} of the longest side: {len(body.faces)} faces")
    if not body.is_watertight or body.volume <= 0:
        raise InputError(name, "cannot be repaired to a closed body", _REMESH)
    body.vertices = scale * (body.vertices - body.bounds.mean(axis=0))
    return body, done


def _closed_by_meshlab(mesh: trimesh.Trimesh, done: list[str]) -> trimesh.Trimesh:
    """The mesh without excess faces and with closed holes, as far as MeshLab can; ``done`` receives what it did."""
    meshes = _opened(mesh)

    def run(text: str, *filters: str, **options) -> None:
        before = meshes.current_mesh().face_number()
        try:
            for name in filters:
                meshes.apply_filter(name, **options)
        except meshlab().PyMeshLabException as error:
            done.append(f"MeshLab cannot apply {name}: {error}")
        if change := meshes.current_mesh().face_number() - before:
            done.append(text.format(abs(change)))

    run(
        "removed {} duplicate or degenerate faces",
        "meshing_remove_duplicate_faces",
        "meshing_remove_null_faces",
    )
    run(
        "removed {} faces at edges of more than two",
        "meshing_repair_non_manifold_edges",
        method="Remove Faces",
    )
    run("", "meshing_repair_non_manifold_vertices")
    run("closed holes with {} faces", "meshing_close_holes", maxholesize=MAX_HOLE_EDGES)
    consistent = _taken(meshes).is_winding_consistent
    run("", "meshing_re_orient_faces_coherently")
    closed = _taken(meshes)
    if not consistent:
        done.append("oriented its faces coherently")
    if not closed.is_watertight:
        done.append("left holes open, where its surface is interpolated")
    return closed


def has_meshlab() -> bool:
    """Whether pymeshlab is installed."""
    return importlib.util.find_spec("pymeshlab") is not None


def meshlab() -> ModuleType:
    """The module pymeshlab. Raises InputError where it is not installed."""
    return require("pymeshlab", "capture")


def crossing_faces(mesh: trimesh.Trimesh) -> int:
    """Number of faces of a mesh that intersect faces without a common vertex or edge."""
    meshes = _opened(mesh)
    meshes.compute_selection_by_self_intersections_per_face()
    return meshes.current_mesh().selected_face_number()


def _mended(mesh: trimesh.Trimesh, edge: float) -> trimesh.Trimesh | None:
    """The largest body without intersecting or degenerate faces and with closed holes; None if this fails."""
    for attempt in range(_ROUNDS):
        meshes = _opened(mesh)
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
        body = _largest(_taken(meshes))
        mesh = None if body is None else _largest(_closed_up(_opened(body)))
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
    return _taken(meshes)


def _wrapped(mesh: trimesh.Trimesh, edge: float) -> trimesh.Trimesh | None:
    meshes = _opened(mesh)
    alpha, offset = (meshlab().PureValue(part * edge) for part in _WRAP)
    meshes.generate_alpha_wrap(alpha=alpha, offset=offset)
    body = _mended(_taken(meshes), edge)
    # a sheet is wrapped from both sides to a thin body
    return None if body is None or body.volume < _MIN_THICKNESS * edge * body.area else body


def _remeshed(mesh: trimesh.Trimesh, edge: float) -> trimesh.Trimesh:
    meshes = _opened(mesh)
    meshes.meshing_isotropic_explicit_remeshing(
        iterations=_REMESHINGS, targetlen=meshlab().PureValue(edge), checksurfdist=False
    )
    return _taken(meshes)


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


def _opened(mesh: trimesh.Trimesh):
    """A MeshLab document with the mesh."""
    pymeshlab = meshlab()
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int32)))
    return meshes


def _taken(meshes) -> trimesh.Trimesh:
    """MeshLab's current mesh."""
    mesh = meshes.current_mesh()
    return trimesh.Trimesh(mesh.vertex_matrix(), mesh.face_matrix(), process=False)
