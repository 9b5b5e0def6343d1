"""Quadratic hexahedra of a solid that consists of blocks."""

from collections.abc import Iterable

import numpy as np
import trimesh

from neuma_lib.errors import InputError
from neuma_lib.geometry.volume import check_mesh, inside
from neuma_lib.sim.hexahedra import Hexahedra

_FLATNESS = 1e-3  # sine of the largest angle between a face and the nearest plane of two axes
_MERGED = 1e-5  # distance below which two planes are one, in units of the body's size


def hexahedra(
    mesh: trimesh.Trimesh, size: float, corners: Iterable[tuple[float, float, float]] = ()
) -> Hexahedra:
    """Mesh of a solid whose faces are parallel to planes of two axes, such as a beam with rectangular sections.

    Each face and each corner lies in planes of a rectilinear grid, which is refined to the size of the elements. An
    element may be thin where two planes are close.

    Args:
        mesh: surface of the solid [m].
        size: largest edge of an element [m].
        corners: points (3,) in which elements end as well, such as the corners of clamps [m].

    Raises:
        InputError: the surface is not closed, or a face is not parallel to two axes.
    """
    check_mesh(mesh)
    extent = float(mesh.extents.max())
    normals, areas = np.abs(mesh.face_normals), mesh.area_faces
    axis = normals.argmax(axis=1)
    sines = np.sqrt(np.maximum(0.0, 1 - normals.max(axis=1) ** 2))
    tilted = (sines > _FLATNESS) & (areas > (_MERGED * extent) ** 2)
    if tilted.any():
        problem = f"{int(tilted.sum())} of {len(axis)} faces are not parallel to two axes"
        raise InputError("mesh", problem, "Only solids that consist of blocks have a mesh of hexahedra")
    planes = []
    for k in range(3):
        own = mesh.triangles[axis == k, :, k].ravel()
        inner = [c[k] for c in corners if own.min() < c[k] < own.max()]
        sites = np.sort(np.concatenate([own, inner]))
        sites = sites[np.diff(sites, prepend=-np.inf) > _MERGED * extent]
        pieces = [
            np.linspace(a, b, int(np.ceil((b - a) / size - 1e-6)), endpoint=False)
            for a, b in zip(sites, sites[1:])
        ]
        planes.append(np.concatenate([*pieces, sites[-1:]]))
    middles = [(plane[1:] + plane[:-1]) / 2 for plane in planes]
    centres = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1)
    filled = inside(mesh, centres.reshape(-1, 3)).reshape(centres.shape[:-1])
    return Hexahedra.of_blocks(planes, filled)
