"""From simulated particles to what is rendered: a solid's own mesh, sand as grains, honey as a surface."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from neuma_lib.config.blender import AppearanceConfig
from neuma_lib.data.blender.appearance import colors_at
from neuma_lib.data.blender.scene import Liquid, Surface
from neuma_lib.extras import require
from neuma_lib.geometry.shapes import depth
from neuma_lib.geometry.skinning import carry, skinning_matrix

MOST_GRAINS = 30_000
MOST_DROPS = 12_000  # points that a liquid's surface is made from
SUNK = 0.5
"""Least depth of a grain's centre at rest, in its radius. The grains' outlines then cover what those of the body do,
within 1 % (letters: 1.1 %), because some stand out by what lacks between others. At 0.8 they cover 1.5 to 3.4 % less: a
body that looks smaller than what was simulated."""


def make_body(
    mesh: trimesh.Trimesh,
    appearance: AppearanceConfig,
    x: np.ndarray,
    tracers: np.ndarray | None = None,
) -> Surface | Liquid:
    """What Blender shows.

    Args:
        mesh: the true shape where the motion starts, from ``shapes.build`` [m].
        appearance: the kind of body, and its colours by rest position.
        x: particle positions, frame 0 at rest in the mesh [m], shape (T, N, 3).
        tracers: passive points of the same motion (T, M, 3) [m]; where they are given, grains and the liquid's
            surface are made from some of them, because they are finer than the particles.
    """
    x = np.asarray(x, dtype=np.float64)
    if appearance.kind == "solid":
        vertices = carry(skinning_matrix(mesh.vertices, x[0]), x)
        return Surface(vertices, np.asarray(mesh.faces), colors_at(mesh, mesh.vertices, appearance))
    points = x if tracers is None else np.asarray(tracers)
    make, most = (_grains, MOST_GRAINS) if appearance.kind == "grains" else (_liquid, MOST_DROPS)
    return make(mesh, appearance, _some(points, most))


def _some(points: np.ndarray, most: int) -> np.ndarray:
    """At most ``most`` of the points (T, M, 3): the same ones in every frame."""
    if points.shape[1] > most:
        points = points[:, np.sort(np.random.default_rng(0).choice(points.shape[1], most, replace=False))]
    return points.astype(np.float64)


def _grains(mesh: trimesh.Trimesh, appearance: AppearanceConfig, points: np.ndarray) -> Surface:
    """Balls somewhat wider than the spacing of their centres, which at rest show the outlines of the body (`SUNK`)."""
    radius = 0.65 * float((mesh.volume / points.shape[1]) ** (1 / 3))
    points = points[:, depth(mesh, points[0]) > SUNK * radius]
    return Surface(points, np.zeros((0, 3), int), colors_at(mesh, points[0], appearance), radius)


def _liquid(mesh: trimesh.Trimesh, appearance: AppearanceConfig, points: np.ndarray) -> Liquid:
    """A surface around the points of every frame; the one at rest holds the true shape's volume within 2 %."""
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
    """Smooth surface of the fluid with the given particles: vertices (n, 3) [m] and faces (m, 3)."""
    # One thread keeps the bytes the same from run to run.
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
