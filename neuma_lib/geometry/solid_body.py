"""The solid body in a mesh of any quality, for example one that another program wrote."""

import numpy as np
import trimesh

from neuma_lib.errors import InputError
from neuma_lib.geometry.repair import MAX_HOLE_EDGES, from_meshlab, meshlab, to_meshlab
from neuma_lib.geometry.shapes import Shape, meshed
from neuma_lib.geometry.volume import signed_distance

_MAX_AREA = 100  # maximum area of a mesh whose longest side is 1. Its distances take a minute; a cube has 6.
_REMESH = (
    "Close its holes and give its walls a thickness, for example with Blender's modifiers Solidify and Remesh"
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
    meshes = to_meshlab(mesh)

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
    consistent = from_meshlab(meshes).is_winding_consistent
    run("", "meshing_re_orient_faces_coherently")
    closed = from_meshlab(meshes)
    if not consistent:
        done.append("oriented its faces coherently")
    if not closed.is_watertight:
        done.append("left holes open, where its surface is interpolated")
    return closed
