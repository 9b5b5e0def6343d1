"""Pinhole cameras with OpenCV axes: +z forward, +x right, +y down. Pixel centres are at half integers."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import torch

from neuma_lib.errors import InputError


@dataclasses.dataclass
class Cameras:
    """V cameras with images of one size.

    Attributes:
        viewmats: (V, 4, 4) world to camera, OpenCV axes, rigid.
        Ks: (V, 3, 3) intrinsics [px], no skew.
        width, height: image size [px].
    """

    viewmats: torch.Tensor
    Ks: torch.Tensor
    width: int
    height: int

    def __post_init__(self):
        count = self.viewmats.shape[0]
        if tuple(self.viewmats.shape) != (count, 4, 4) or tuple(self.Ks.shape) != (count, 3, 3):
            shapes = f"{tuple(self.viewmats.shape)} and {tuple(self.Ks.shape)}"
            raise InputError("cameras: viewmats, Ks", f"have {shapes}, expected (V, 4, 4) and (V, 3, 3)")
        if self.width <= 0 or self.height <= 0:
            raise InputError("cameras: width, height", f"must be positive, not {self.width} x {self.height}")
        self.width, self.height = int(self.width), int(self.height)

    def __len__(self) -> int:
        return self.viewmats.shape[0]

    def __getitem__(self, index) -> Cameras:
        """Select cameras by an int, slice or sequence of ints."""
        index = [index] if isinstance(index, int) else index
        return Cameras(self.viewmats[index], self.Ks[index], self.width, self.height)

    def __iter__(self) -> Iterator[Cameras]:
        """Iterate over the cameras as sets of one."""
        return (self[view] for view in range(len(self)))

    @classmethod
    def joined(cls, cameras: Cameras | Sequence[Cameras]) -> Cameras:
        """Concatenate sets of cameras, with the largest image size. Poses and intrinsics are valid, sizes are not."""
        if isinstance(cameras, Cameras):
            return cameras
        viewmats, Ks = (torch.cat([getattr(c, name) for c in cameras]) for name in ("viewmats", "Ks"))
        return cls(viewmats, Ks, max(c.width for c in cameras), max(c.height for c in cameras))

    def to(self, device=None, dtype: torch.dtype | None = None) -> Cameras:
        return Cameras(self.viewmats.to(device, dtype), self.Ks.to(device, dtype), self.width, self.height)

    @property
    def positions(self) -> torch.Tensor:
        """(V, 3) camera centres in the world frame [m]."""
        return -torch.einsum("vji,vj->vi", self.viewmats[:, :3, :3], self.viewmats[:, :3, 3])

    def project(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Image coordinates and depth of world points.

        Args:
            points: (P, 3) in the world frame [m].

        Returns:
            pixels (V, P, 2) and depths (V, P) [m]; points with depth <= 0 are behind the camera.
        """
        local = torch.einsum("vij,pj->vpi", self.viewmats[:, :3, :3], points) + self.viewmats[:, None, :3, 3]
        image = torch.einsum("vij,vpj->vpi", self.Ks, local)
        return image[..., :2] / image[..., 2:], local[..., 2]


def look_at(eyes: torch.Tensor, target: torch.Tensor, up: torch.Tensor) -> torch.Tensor:
    """World-to-camera matrices (V, 4, 4), OpenCV axes, of cameras at ``eyes`` (V, 3) that face ``target`` (3,).

    ``up`` (3,) is the up direction of the images in the world, not parallel to a line of sight.
    """
    forward = torch.nn.functional.normalize(target - eyes, dim=-1)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up.expand_as(forward)), dim=-1)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward], dim=-2)
    viewmats = torch.zeros(eyes.shape[0], 4, 4, dtype=eyes.dtype, device=eyes.device)
    viewmats[:, :3, :3] = rotation
    viewmats[:, :3, 3] = -(rotation @ eyes[..., None])[..., 0]
    viewmats[:, 3, 3] = 1
    return viewmats
