"""The Gaussians of a static object (paper Sec. 3.3: x, alpha, A, c)."""

from __future__ import annotations

import dataclasses

import torch

from neuma_lib.errors import InputError
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.spherical_harmonics import MAX_DEGREE, coefficient_count


@dataclasses.dataclass
class Gaussians:
    """G anisotropic 3D Gaussians.

    Attributes:
        means: (G, 3) centres, world frame [m].
        quats: (G, 4) rotations as quaternions (w, x, y, z); need not be normalised.
        scales: (G, 3) standard deviations along the rotated axes [m].
        opacities: (G,) in (0, 1).
        sh0: (G, 1, 3) spherical harmonics of degree 0.
        shN: (G, K - 1, 3) the higher degrees, K = 1, 4, 9 or 16.
    """

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    sh0: torch.Tensor
    shN: torch.Tensor

    def __post_init__(self):
        count = self.means.shape[0]
        expected = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3)}
        for name, shape in expected.items():
            if tuple(getattr(self, name).shape) != (count, *shape):
                actual = tuple(getattr(self, name).shape)
                raise InputError(f"gaussians: {name}", f"has shape {actual}, expected {(count, *shape)}")
        allowed = [coefficient_count(degree) - 1 for degree in range(MAX_DEGREE + 1)]
        if self.shN.dim() != 3 or self.shN.shape[0] != count or self.shN.shape[1] not in allowed:
            raise InputError("gaussians: shN", f"has shape {tuple(self.shN.shape)}, expected (G, K - 1, 3)")

    def __len__(self) -> int:
        return self.means.shape[0]

    def __getitem__(self, index) -> Gaussians:
        """Select Gaussians by a boolean mask, an index tensor or a slice."""
        return Gaussians(*(getattr(self, field.name)[index] for field in dataclasses.fields(self)))

    def to(self, device=None, dtype: torch.dtype | None = None) -> Gaussians:
        return Gaussians(*(getattr(self, field.name).to(device, dtype) for field in dataclasses.fields(self)))

    def sh(self) -> torch.Tensor:
        """(G, K, 3) all harmonics."""
        return torch.cat([self.sh0, self.shN], dim=1)

    def covars(self) -> torch.Tensor:
        """(G, 3, 3) covariances A_0 = R S^2 R^T [m^2]."""
        return covariances(self.quats, self.scales)

    def absorbing_blur(self, cameras: Cameras, eps2d: float) -> Gaussians:
        """The Gaussians enlarged by the pixel blur of the cameras.

        Splatting adds the variance ``eps2d`` [px^2] to every projected Gaussian, so Gaussians fitted with some cameras
        look larger in cameras with larger pixels. This method adds ``eps2d``, converted to metres at the mean camera,
        to the Gaussians. Rendered with ``eps2d=0`` they look the same in those cameras and have the same size in others
        (as with the 3D smoothing filter of Mip-Splatting, Yu et al. 2024).
        """
        _, depth = cameras.project(self.means)
        focal = cameras.Ks[:, 0, 0].to(depth)
        blur = eps2d * (depth / focal[:, None]).square().mean(dim=0)
        return dataclasses.replace(self, scales=(self.scales.square() + blur[:, None]).sqrt())

    def cull(self, min_opacity: float) -> Gaussians:
        """The Gaussians with opacity above ``min_opacity`` (0.02 in the paper)."""
        return self[self.opacities > min_opacity]


def rotations(quats: torch.Tensor) -> torch.Tensor:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), w first, which are normalised first."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def covariances(quats: torch.Tensor, scales: torch.Tensor) -> torch.Tensor:
    """(G, 3, 3) R S S^T R^T of rotations (G, 4) and standard deviations (G, 3)."""
    half = rotations(quats) * scales[..., None, :]
    return half @ half.mT


def quaternions(rotations: torch.Tensor) -> torch.Tensor:
    """Unit quaternions (..., 4), w first and w >= 0, of rotation matrices (..., 3, 3)."""
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = rotations.flatten(-2).unbind(-1)
    # 4 q q^T: the row with the largest diagonal element, normalised, has no cancellation
    rows = [
        1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01,
        m21 - m12, 1 + m00 - m11 - m22, m10 + m01, m02 + m20,
        m02 - m20, m10 + m01, 1 - m00 + m11 - m22, m12 + m21,
        m10 - m01, m02 + m20, m12 + m21, 1 - m00 - m11 + m22,
    ]  # fmt: skip
    products = torch.stack(rows, dim=-1).unflatten(-1, (4, 4))
    largest = products.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    row = products.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4))[..., 0, :]
    return torch.nn.functional.normalize(torch.where(row[..., :1] < 0, -row, row), dim=-1)
