"""Rendered geometry of simulated particles: the mesh of a solid, grains of sand, or the surface of a liquid."""

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from neuma_lib.config.blender import AppearanceConfig
from neuma_lib.data.blender.appearance import colors_at
from neuma_lib.data.blender.scene import Liquid, Surface
from neuma_lib.extras import require
from neuma_lib.geometry.moving_surface import moving_surface
from neuma_lib.geometry.shapes import depth

MAX_GRAINS = 30_000
MAX_DROPS = 12_000  # points that define the surface of a liquid
MIN_DEPTH = 0.5
"""Minimum depth of a grain's centre at rest, in radii. The silhouette of the grains then has the area of that of the
body within 1 % (letters: 1.1 %), because protrusions compensate gaps. A depth of 0.8 gives 1.5 to 3.4 % less area."""


def make_body(
    mesh: trimesh.Trimesh, appearance: AppearanceConfig, x: np.ndarray, tracers: np.ndarray | None = None
) -> Surface | Liquid:
    """Geometry for Blender.

    Args:
        mesh: the true shape at the start of the motion, from ``shapes.build`` [m].
        appearance: the kind of body, and its colours by rest position.
        x: particle positions, frame 0 at rest in the mesh [m], shape (T, N, 3).
        tracers: passive points of the same motion [m], shape (T, M, 3). If given, they are used for grains and liquids,
            because they are denser than the particles.
    """
    x = np.asarray(x, dtype=np.float64)
    if appearance.kind == "solid":
        return Surface(
            moving_surface(mesh, x), np.asarray(mesh.faces), colors_at(mesh, mesh.vertices, appearance)
        )
    points = x if tracers is None else np.asarray(tracers)
    make, limit = (_grains, MAX_GRAINS) if appearance.kind == "grains" else (_liquid, MAX_DROPS)
    return make(mesh, appearance, _subsampled(points, limit))


def _subsampled(points: np.ndarray, limit: int) -> np.ndarray:
    """At most ``limit`` of the points (T, M, 3), the same ones in every frame."""
    if points.shape[1] > limit:
        points = points[:, np.sort(np.random.default_rng(0).choice(points.shape[1], limit, replace=False))]
    return points.astype(np.float64)


def _grains(mesh: trimesh.Trimesh, appearance: AppearanceConfig, points: np.ndarray) -> Surface:
    """Balls wider than the spacing of their centres, with the silhouette of the body at rest (`MIN_DEPTH`)."""
    radius = 0.65 * float((mesh.volume / points.shape[1]) ** (1 / 3))
    points = points[:, depth(mesh, points[0]) > MIN_DEPTH * radius]
    return Surface(points, np.zeros((0, 3), int), colors_at(mesh, points[0], appearance), radius)


def _liquid(mesh: trimesh.Trimesh, appearance: AppearanceConfig, points: np.ndarray) -> Liquid:
    """A surface around the points of every frame; at rest it has the volume of the true shape within 2 %."""
    spacing = float((mesh.volume / points.shape[1]) ** (1 / 3))
    rest_colors = colors_at(mesh, points[0], appearance)
    surfaces = []
    for frame in points:
        vertices, faces = _liquid_surface(frame, spacing)
        distance, near = cKDTree(frame).query(vertices, k=8)
        weight = 1.0 / (distance**2 + (0.5 * spacing) ** 2)
        weight /= weight.sum(axis=1, keepdims=True)
        surfaces.append((vertices, faces, np.einsum("vk,vkc->vc", weight, rest_colors[near])))
    return Liquid(surfaces)


def _liquid_surface(points: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Smooth surface of a fluid of particles: vertices (n, 3) [m] and faces (m, 3)."""
    # one thread, for deterministic results
    result = require("pysplashsurf", "blender").reconstruction_pipeline(
        np.ascontiguousarray(points, dtype=np.float64),
        particle_radius=spacing / 2,
        smoothing_length=2.5,
        cube_size=1.0,
        iso_surface_threshold=0.48,
        mesh_cleanup=True,
        mesh_smoothing_iters=15,
        mesh_smoothing_weights=True,
        multi_threading=False,
    )
    result = result[0] if isinstance(result, tuple) else result
    surface = getattr(result, "mesh", result)
    return np.asarray(surface.vertices, dtype=np.float64), np.asarray(surface.triangles, dtype=np.int64)
