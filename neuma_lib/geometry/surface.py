"""A watertight surface of a static object from its silhouettes: the zero level of the visual hull's signed distance.

The surface is more accurate than a pixel or voxel (see `neuma_lib.geometry.visual_hull`). Dents that no silhouette
shows stay filled unless depth maps are given. Gaussians fitted to the same views bound the search.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import marching_cubes
from torch import Tensor

from neuma_lib.config.geometry import SurfaceConfig
from neuma_lib.errors import InputError
from neuma_lib.geometry.depth_fusion import REACH, fused_distance
from neuma_lib.geometry.repair import repaired
from neuma_lib.geometry.visual_hull import contour_distances, distance_inside, no_common_space
from neuma_lib.geometry.volume import check_mesh
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians

Array = NDArray[np.float64]

BOX_SIDE = 1.0
"""Side of the simulator's box [m]."""
_COARSE_RESOLUTION = 32
"""Voxels along the longest side of the coarse grid that locates the body and the band around its surface."""


@dataclass(frozen=True)
class _Grid:
    """Regular grid of points: origin (3,) [m], spacing [m], points along each axis."""

    origin: Array
    spacing: float
    counts: NDArray[np.int64]

    @classmethod
    def around(cls, lower: Array, upper: Array, resolution: int) -> "_Grid":
        spacing = float((upper - lower).max()) / resolution
        return cls(lower, spacing, np.ceil((upper - lower) / spacing).astype(np.int64) + 1)

    def axes(self) -> list[Array]:
        return [self.origin[k] + self.spacing * np.arange(n) for k, n in enumerate(self.counts)]


def reconstruct(
    gaussians: Gaussians,
    cameras: Cameras | Sequence[Cameras],
    images: Tensor | Sequence[Tensor],
    settings: SurfaceConfig,
    floor: float | None = None,
    depths: Sequence[Tensor] | None = None,
) -> trimesh.Trimesh:
    """Surface of the body in the views (paper, section 3.2, which uses a multi-view method).

    Args:
        gaussians: static reconstruction; its extent initialises the search region.
        cameras: V views, or V sets of one if sizes differ.
        images: RGBA with straight alpha in [0, 1] of V views, shape (H, W, 4) each.
        settings: resolution and smoothing.
        floor: height y [m] of a floor that hides the underside from the cameras; None: no floor.
        depths: depth of the surface along the optical axes [m] in V views, shape (H, W) each, not finite where a pixel
            shows none. None: silhouettes alone.

    Returns:
        Watertight mesh in the world frame [m], one body without inner cavities, oriented outwards.

    Raises:
        InputError: images do not match the cameras, a matte is empty, or the mattes have no common point of space.
    """
    for view, (image, camera) in enumerate(zip(images, cameras)):
        if tuple(image.shape) != (camera.height, camera.width, 4):
            problem = (
                f"the image has shape {tuple(image.shape)}, expected ({camera.height}, {camera.width}, 4)"
            )
            raise InputError(f"surface: view {view}", problem)
    cameras = [camera.to("cpu", torch.float64) for camera in cameras]
    contours = contour_distances([image[..., 3] for image in images], settings.matte_level)

    coarse, distance = _locate(gaussians, contours, cameras, floor)
    reach = 2.0 * coarse.spacing
    near = np.argwhere(distance > -coarse.spacing)
    lower = coarse.origin + (near.min(axis=0) - 1) * coarse.spacing
    upper = coarse.origin + (near.max(axis=0) + 1) * coarse.spacing
    grid = _Grid.around(lower, upper, settings.resolution)
    # away from the surface only the sign matters, so the coarse distance is sufficient
    at = [(axis - coarse.origin[k]) / coarse.spacing for k, axis in enumerate(grid.axes())]
    field = ndimage.map_coordinates(
        distance, np.stack(np.meshgrid(*at, indexing="ij")), order=1, mode="nearest"
    )
    band = np.flatnonzero(np.abs(field.ravel()) < reach)
    points = np.stack(np.unravel_index(band, field.shape), axis=1) * grid.spacing + grid.origin
    field.ravel()[band] = distance_inside(torch.from_numpy(points), contours, cameras, floor).numpy()
    if depths is not None:
        inside = np.flatnonzero(field.ravel() > -grid.spacing)
        behind = REACH * grid.spacing * settings.resolution
        points = np.stack(np.unravel_index(inside, field.shape), axis=1) * grid.spacing + grid.origin
        fused = fused_distance(torch.from_numpy(points), depths, cameras, behind)
        field.ravel()[inside] = np.minimum(field.ravel()[inside], fused.numpy())

    mesh = _polygonise(_one_solid_body(field), grid)
    if settings.smoothing:
        _smooth(mesh, settings.smoothing)
    if floor is not None:  # smoothing may move vertices below the floor
        mesh.vertices[:, 1] = np.maximum(mesh.vertices[:, 1], floor)
    check_mesh(mesh, "surface")
    return mesh


def photographed(mesh: trimesh.Trimesh, edge: float, floor: float | None) -> trimesh.Trimesh:
    """The surface of a photographed body, repaired, remeshed, and moved above the floor.

    Args:
        mesh: result of `reconstruct`, in the simulator's box [m].
        edge: length of an edge, as a fraction of the longest side.
        floor: height of the floor [m]; None: no floor.

    Raises:
        InputError: pymeshlab is missing, no closed body is left, or it is outside the simulator's box.
    """
    body = repaired(mesh, edge * float(mesh.extents.max()), "surface")
    if floor is not None:
        body.vertices[:, 1] = np.maximum(body.vertices[:, 1], floor)
    check_mesh(body, "surface")
    lower, upper = body.bounds
    if (lower < 0).any() or (upper > BOX_SIDE).any():
        extent = ", ".join(f"{axis} {a:.2f} to {b:.2f}" for axis, a, b in zip("xyz", lower, upper))
        problem = f"the body ({extent} m) exceeds the simulator's box, 0 to {BOX_SIDE:g} m along each axis"
        raise InputError("surface", problem, "Correct `center`, or reduce `scale`, in capture.yaml")
    return body


def _locate(
    gaussians: Gaussians, contours: Sequence[Tensor], cameras: Sequence[Cameras], floor: float | None
) -> tuple[_Grid, Array]:
    """Coarse grid around the whole body, and the distances on it.

    It starts from the bounding box of the Gaussians, which is doubled while the body reaches its border.
    """
    if len(gaussians) == 0:
        raise InputError("surface: gaussians", "there are no Gaussians", "Run the rule gaussians again")
    means = gaussians.means.detach().to("cpu", torch.float64).numpy()
    reach = 2.0 * gaussians.covars().detach().diagonal(dim1=1, dim2=2).sqrt().to("cpu", torch.float64).numpy()
    if not (np.isfinite(means).all() and np.isfinite(reach).all()):
        raise InputError("surface: gaussians", "a Gaussian is not finite", "Run the rule gaussians again")
    lower, upper = (means - reach).min(axis=0), (means + reach).max(axis=0)
    for _ in range(6):
        margin = 0.05 * float((upper - lower).max())
        grid = _Grid.around(lower - margin, upper + margin, _COARSE_RESOLUTION)
        points = torch.cartesian_prod(*map(torch.from_numpy, grid.axes()))
        distance = distance_inside(points, contours, cameras, floor).numpy().reshape(tuple(grid.counts))
        interior = np.zeros(distance.shape, dtype=bool)
        interior[1:-1, 1:-1, 1:-1] = True
        if (distance > -grid.spacing).any() and not (distance[~interior] > 0).any():
            return grid, distance
        middle, half = (lower + upper) / 2, (upper - lower).max() / 2
        lower, upper = middle - 2 * half, middle + 2 * half
    if (distance > -grid.spacing).any():
        remedy = "Add views from other directions, or use masks that the frame does not crop"
        raise InputError("masks", "they do not bound a body", remedy)
    raise no_common_space()


def _one_solid_body(field: Array) -> Array:
    """The field of the largest body alone, without cavities, and closed at the border of the grid."""
    field = np.pad(field, 1, constant_values=min(float(field.min()), -1e-6))
    bodies, count = ndimage.label(field > 0)
    if count == 0:
        raise no_common_space("Increase geometry.surface.resolution if the body is thinner than a voxel")
    largest = 1 + int(np.argmax(np.bincount(bodies.ravel())[1:]))
    filled = ndimage.binary_fill_holes(bodies == largest)
    return np.where(filled, np.maximum(field, -field), np.minimum(field, -field))


def _polygonise(field: Array, grid: _Grid) -> trimesh.Trimesh:
    """Zero level of a field padded by one."""
    # values near zero give degenerate faces
    minimum = 1e-3 * grid.spacing
    field = np.where(field > 0, np.maximum(field, minimum), np.minimum(field, -minimum))
    vertices, faces, _, _ = marching_cubes(field, 0.0, gradient_direction="ascent")
    return trimesh.Trimesh(grid.origin + (vertices - 1.0) * grid.spacing, faces)


def _smooth(mesh: trimesh.Trimesh, rounds: int) -> None:
    """Taubin smoothing, in place; an offset along the normals restores the volume to second order."""
    before = mesh.volume
    trimesh.smoothing.filter_taubin(mesh, lamb=0.5, nu=0.53, iterations=2 * rounds)
    mesh.vertices = mesh.vertices + (before - mesh.volume) / mesh.area * mesh.vertex_normals
