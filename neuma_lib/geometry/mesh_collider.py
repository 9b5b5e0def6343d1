"""Colliders with the shape of a mesh, for simulations."""

import numpy as np
import trimesh

from neuma_lib.errors import InputError
from neuma_lib.geometry.volume import check_mesh, signed_distance
from neuma_lib.sim.colliders import Collider, DistanceGrid

MARGIN = 0.03
"""Distance [m] from a mesh to the end of its grid. Larger than the radii of particles, which are at most 0.01 m for
1,000 particles in a volume of 0.2^3 m^3, so that contact is within the grid."""


def mesh_collider(mesh: trimesh.Trimesh, cells: int = 64, **options) -> Collider:
    """A collider with the shape of a mesh, as its signed distance on a grid.

    With a spacing h, an interpolated distance is too large by at most h^2 / (4 r) at points that are farther than r + h
    from the centres of curvature of the surface. Near edges and the medial axis the error is at most h.

    Args:
        mesh: watertight, oriented outwards [m], in the frame of the collider.
        cells: along the longest edge of the grid, which extends `MARGIN` beyond the mesh.
        options: as for `Collider`, without ``shape`` and ``size``.

    Raises:
        InputError: the mesh is not closed or the number of cells less than 4, or as `Collider`.
    """
    check_mesh(mesh, "collider.mesh")
    if not isinstance(cells, int) or cells < 4:
        raise InputError("collider.cells", f"{cells!r} must be an integer of at least 4")
    lowest, extents = mesh.bounds[0] - MARGIN, mesh.extents + 2 * MARGIN
    spacing = float(extents.max()) / cells
    ticks = [
        low + spacing * np.arange(np.ceil(e / spacing - 1e-9) + 1)
        for low, e in zip(lowest, extents, strict=True)
    ]
    nodes = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1)
    values = signed_distance(mesh, nodes.reshape(-1, 3)).reshape(nodes.shape[:3])
    return Collider("mesh", distances=DistanceGrid(values, tuple(lowest.tolist()), spacing), **options)
