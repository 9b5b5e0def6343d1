"""Distance of the surface of a splat from the one on which its Gaussians lie.

    python -m benchmarks.splat_surface                # 6,000 discs, 96 voxels, 60 views of 320 px; minutes
    python -m benchmarks.splat_surface --shapes bowl --discs 3000
    python -m benchmarks.splat_surface --gaussians results/Guitar/gaussians.ply

Opaque discs lie at random on a bowl, whose inside no silhouette shows, on a cat, with gaps between the discs in a few
views, and on shapes that did not influence any setting, such as a pot with a thin wall. Prints the mean distance of
points on either surface to the other, and the volume over the true one, from silhouettes alone and with depth. For
Gaussians with an unknown surface it prints both volumes.
"""

import argparse
import math
import time
from collections.abc import Callable

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree

from benchmarks.timing import parser_of
from neuma_lib.config.geometry import SurfaceConfig
from neuma_lib.geometry.shapes import place
from neuma_lib.geometry.splat_surface import splat_surface, views_around
from neuma_lib.io.gaussians import load_gaussians
from neuma_lib.splatting.gaussians import Gaussians, quaternions

SIZE = 0.4  # longest side [m]
SAMPLES = 20_000  # points on a surface that distances are measured at


def bowl() -> trimesh.Trimesh:
    """A bowl that is open upwards, 0.4 m wide and 0.2 m high, its wall 0.03 m thick."""
    profile = [
        (0, 0),
        (0.15, 0),
        (0.18, 0.05),
        (0.2, 0.2),
        (0.17, 0.2),
        (0.15, 0.06),
        (0.12, 0.03),
        (0, 0.03),
    ]
    return upright(profile)


def pot() -> trimesh.Trimesh:
    """A pot that is open upwards, 0.3 m wide and 0.4 m high, its wall 0.02 m thick."""
    return upright([(0, 0), (0.15, 0), (0.15, 0.4), (0.13, 0.4), (0.13, 0.02), (0, 0.02)])


def upright(profile: list[tuple[float, float]]) -> trimesh.Trimesh:
    """Solid of revolution of a profile (radius, height) [m] about the vertical, above the middle of the floor."""
    mesh = trimesh.creation.revolve(np.array(profile), sections=64)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    mesh.apply_translation([0.5, 0.4, 0.5])
    return mesh


def solid(name: str) -> Callable[[], trimesh.Trimesh]:
    """A shape of the benchmark scenes, its longest side `SIZE`."""
    return lambda: place(name, SIZE, 0.5, (0.5, 0.5), resolution=96)


CHOSEN_ON = {"bowl": bowl, "cat": solid("cat")}
"""Shapes on which the settings of the search were chosen."""
SHAPES = {**CHOSEN_ON, "pot": pot, **{name: solid(name) for name in ("duck", "fish", "pawn")}}


def drawn_on(mesh: trimesh.Trimesh, count: int) -> tuple[Gaussians, float]:
    """A splat of opaque discs that lie in a surface, as trainers leave them, and the distance between them [m]."""
    rng = np.random.default_rng(0)
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    normal = mesh.face_normals[faces]
    along = np.cross(normal, rng.normal(size=normal.shape))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    spacing = math.sqrt(mesh.area / count)
    axes = torch.from_numpy(np.stack([normal, along, np.cross(normal, along)], axis=2))
    made = {
        "means": torch.from_numpy(points), "quats": quaternions(axes), "opacities": torch.full((count,), 0.95),
        "scales": spacing * torch.tensor([0.1, 0.7, 0.7]).repeat(count, 1),
        "sh0": torch.zeros(count, 1, 3), "shN": torch.zeros(count, 0, 3),
    }  # fmt: skip
    return Gaussians(**{name: value.float() for name, value in made.items()}), spacing


def between(a: trimesh.Trimesh, b: trimesh.Trimesh) -> np.ndarray:
    """Distances [m] of points on either surface to points on the other."""
    clouds = [trimesh.sample.sample_surface(mesh, SAMPLES, seed=1)[0] for mesh in (a, b)]
    return np.concatenate([cKDTree(one).query(other)[0] for one, other in (clouds, clouds[::-1])])


def compare(
    name: str, gaussians: Gaussians, truth: trimesh.Trimesh | None, chosen: argparse.Namespace
) -> None:
    cameras = views_around(gaussians, chosen.views, chosen.pixels)
    settings = SurfaceConfig(resolution=chosen.voxels)
    for dents in (False, True):
        began = time.process_time()
        surface = splat_surface(gaussians, cameras, settings, dents=dents)
        used = time.process_time() - began
        result = f"{1e3 * surface.volume:.3f} l"
        if truth is not None:
            gaps = 1e3 * between(surface, truth)
            far = np.quantile(gaps, 0.95)
            share = surface.volume / truth.volume
            result = f"{share:.2f} of the true one, {gaps.mean():.1f} mm, 95 % below {far:.1f} mm"
        bodies = len(surface.split(only_watertight=False))
        print(
            f"{name}, {'with depth' if dents else 'silhouettes alone'}: volume {result}; "
            f"closed: {surface.is_watertight}, bodies: {bodies}, {used:.1f} core s"
        )


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--shapes", nargs="+", choices=SHAPES, default=[*SHAPES])
    parser.add_argument("--discs", type=int, default=6000)
    parser.add_argument("--gaussians", nargs="+", help="files of Gaussians to take in place of shapes")
    parser.add_argument("--voxels", type=int, default=96)
    parser.add_argument("--views", type=int, default=60)
    parser.add_argument("--pixels", type=int, default=320)
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    for file in chosen.gaussians or ():
        compare(file, load_gaussians(file), None, chosen)
    for shape in () if chosen.gaussians else chosen.shapes:
        truth = SHAPES[shape]()
        gaussians, spacing = drawn_on(truth, chosen.discs)
        compare(f"{shape}, discs {1e3 * spacing:.1f} mm apart", gaussians, truth, chosen)


if __name__ == "__main__":
    main()
