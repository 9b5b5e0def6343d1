"""Pinhole cameras: OpenCV extrinsics and intrinsics, and the transforms.json frames that store them.

A camera looks along its +z axis with +x right and +y down (OpenCV); ``transforms.json`` keeps camera-to-world
matrices in OpenGL axes (+y up, looking along -z), as in NeRF datasets. Pixel centres are at half integers.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from neuma_lib.errors import InputError

_FLIP_YZ = (1.0, -1.0, -1.0, 1.0)


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
            raise InputError(
                f"cameras: viewmats {tuple(self.viewmats.shape)} and Ks {tuple(self.Ks.shape)} "
                "must be (V, 4, 4) and (V, 3, 3)"
            )
        if self.width <= 0 or self.height <= 0:
            raise InputError(f"cameras: image size {self.width} x {self.height} must be positive")
        self.width, self.height = int(self.width), int(self.height)

    def __len__(self) -> int:
        return self.viewmats.shape[0]

    def __getitem__(self, index) -> Cameras:
        """Some of the cameras: an int, slice or sequence of ints."""
        index = [index] if isinstance(index, int) else index
        return Cameras(self.viewmats[index], self.Ks[index], self.width, self.height)

    def to(self, device=None, dtype: torch.dtype | None = None) -> Cameras:
        return Cameras(self.viewmats.to(device, dtype), self.Ks.to(device, dtype), self.width, self.height)

    @property
    def positions(self) -> torch.Tensor:
        """(V, 3) camera centres, world frame [m]."""
        return -torch.einsum("vji,vj->vi", self.viewmats[:, :3, :3], self.viewmats[:, :3, 3])

    def project(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Image coordinates and depth of world points.

        Args:
            points: (P, 3) world frame [m].

        Returns:
            pixels (V, P, 2) and depths (V, P) [m]; points with depth <= 0 are behind the camera.
        """
        local = torch.einsum("vij,pj->vpi", self.viewmats[:, :3, :3], points) + self.viewmats[:, None, :3, 3]
        image = torch.einsum("vij,vpj->vpi", self.Ks, local)
        return image[..., :2] / image[..., 2:], local[..., 2]

    @classmethod
    def from_opengl(cls, c2w: torch.Tensor, Ks: torch.Tensor, width: int, height: int) -> Cameras:
        """Cameras from camera-to-world matrices (V, 4, 4) in OpenGL axes."""
        flip = torch.tensor(_FLIP_YZ, dtype=c2w.dtype, device=c2w.device)
        return cls(invert_rigid(c2w * flip), Ks, width, height)

    def to_opengl(self) -> torch.Tensor:
        """(V, 4, 4) camera-to-world matrices in OpenGL axes."""
        flip = torch.tensor(_FLIP_YZ, dtype=self.viewmats.dtype, device=self.viewmats.device)
        return invert_rigid(self.viewmats) * flip

    @classmethod
    def from_transforms(
        cls,
        transforms: Mapping[str, Any],
        frames: Sequence[Mapping[str, Any]] | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> Cameras:
        """Cameras of the frames of a parsed transforms.json.

        Intrinsics (fl_x, fl_y, cx, cy, w, h) may stand in the frame or at the top of the file;
        ``camera_angle_x`` with ``w`` and ``h`` is understood too.

        Args:
            transforms: the parsed file.
            frames: which of its frames, default all.

        Raises:
            InputError: intrinsics or a transform_matrix are missing, or image sizes differ.
        """
        frames = transforms.get("frames", []) if frames is None else frames
        if not frames:
            raise InputError("transforms.json: `frames` is missing or empty")
        c2w, Ks, sizes = [], [], set()
        for i, frame in enumerate(frames):
            name = frame.get("file_path", f"frames[{i}]")
            if "transform_matrix" not in frame:
                raise InputError(f"transforms.json: {name} has no `transform_matrix`")
            c2w.append(torch.tensor(frame["transform_matrix"], dtype=torch.float64))
            K, size = _intrinsics({**transforms, **frame}, name)
            Ks.append(K)
            sizes.add(size)
        if len(sizes) > 1:
            raise InputError(
                f"transforms.json: images of different sizes {sorted(sizes)}; load them in groups"
            )
        width, height = sizes.pop()
        cameras = cls.from_opengl(torch.stack(c2w), torch.stack(Ks), width, height)
        return cameras.to(dtype=dtype)

    def to_transforms(self) -> list[dict[str, Any]]:
        """One dict a camera with ``transform_matrix`` and intrinsics, as the frames of a transforms.json."""
        fields = ("fl_x", (0, 0)), ("fl_y", (1, 1)), ("cx", (0, 2)), ("cy", (1, 2))
        frames = []
        for matrix, K in zip(self.to(dtype=torch.float64).to_opengl(), self.Ks.double(), strict=True):
            frame: dict[str, Any] = {name: float(K[at]) for name, at in fields}
            frames.append({**frame, "w": self.width, "h": self.height, "transform_matrix": matrix.tolist()})
        return frames


def invert_rigid(matrices: torch.Tensor) -> torch.Tensor:
    """Inverse of rigid transforms (..., 4, 4); also of rotations with mirrored axes."""
    rotation = matrices[..., :3, :3].mT
    inverse = torch.zeros_like(matrices)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3] = -(rotation @ matrices[..., :3, 3:])[..., 0]
    inverse[..., 3, 3] = 1
    return inverse


def look_at(eyes: torch.Tensor, target: torch.Tensor, up: torch.Tensor) -> torch.Tensor:
    """World-to-camera matrices (V, 4, 4), OpenCV axes, of cameras at ``eyes`` (V, 3) facing ``target`` (3,).

    ``up`` (3,) is the world direction that points up in the images; not parallel to a line of sight.
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


def _intrinsics(values: Mapping[str, Any], name: str) -> tuple[torch.Tensor, tuple[int, int]]:
    if "w" not in values or "h" not in values:
        raise InputError(f"transforms.json: {name} has no image size, add `w` and `h`")
    width, height = int(values["w"]), int(values["h"])
    if "fl_x" in values:
        focal_x = float(values["fl_x"])
    elif "camera_angle_x" in values:
        focal_x = 0.5 * width / math.tan(0.5 * float(values["camera_angle_x"]))
    else:
        raise InputError(f"transforms.json: {name} has no intrinsics, add `fl_x`, `fl_y`, `cx`, `cy`")
    K = torch.eye(3, dtype=torch.float64)
    K[0, 0], K[1, 1] = focal_x, float(values.get("fl_y", focal_x))
    K[0, 2], K[1, 2] = float(values.get("cx", width / 2)), float(values.get("cy", height / 2))
    return K, (width, height)
