"""Kernels of points in closed surfaces."""

from __future__ import annotations

import torch
import trimesh

from neuma_lib.geometry.volume import inside


def compile_kernels(device: torch.device) -> None:
    """Whether a point is in a box; computed on the CPU whatever the device."""
    inside(trimesh.creation.box(), trimesh.creation.box().centroid[None])
