"""Kernels of points in closed surfaces, and of nearest neighbours."""

import torch
import trimesh

from neuma_lib.geometry.nearest import nearest
from neuma_lib.geometry.volume import inside


def compile_kernels(device: torch.device) -> None:
    """Whether a point is in a box, computed on the CPU whatever the device; neighbours there and on it, for distances
    in double precision."""
    inside(trimesh.creation.box(), trimesh.creation.box().centroid[None])
    for place in {torch.device("cpu"), device}:
        point = torch.zeros(1, 3, dtype=torch.float64, device=place)
        nearest(point, [1], point, [1])
