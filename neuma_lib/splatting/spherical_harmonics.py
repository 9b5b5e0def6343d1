"""Real spherical harmonics up to degree 3, in the order and sign of 3D Gaussian splatting files.

The Warp kernels of ``projection.py`` use the polynomials and coefficients of ``basis``.
"""

import math

import torch

SH_C0 = 0.5 / math.sqrt(math.pi)
SH_C1 = math.sqrt(3.0 / (4.0 * math.pi))
SH_C2 = (
    math.sqrt(15.0 / (4.0 * math.pi)),
    math.sqrt(5.0 / (16.0 * math.pi)),
    math.sqrt(15.0 / (16.0 * math.pi)),
)
SH_C3 = (
    math.sqrt(35.0 / (32.0 * math.pi)),
    math.sqrt(105.0 / (4.0 * math.pi)),
    math.sqrt(21.0 / (32.0 * math.pi)),
    math.sqrt(7.0 / (16.0 * math.pi)),
    math.sqrt(105.0 / (16.0 * math.pi)),
)
MAX_DEGREE = 3


def coefficient_count(degree: int) -> int:
    """Number K of coefficients per colour channel for an SH degree: 1, 4, 9, 16."""
    return (degree + 1) ** 2


def basis(directions: torch.Tensor, count: int) -> torch.Tensor:
    """Values of the first ``count`` harmonics.

    Args:
        directions: (..., 3) unit vectors, world frame, from the camera to the Gaussian.
        count: 1, 4, 9 or 16.

    Returns:
        (..., count)
    """
    x, y, z = directions.unbind(-1)
    values = [torch.full_like(x, SH_C0)]
    if count > 1:
        values += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if count > 4:
        a, b, c = SH_C2
        values += [a * x * y, -a * y * z, b * (2 * z * z - x * x - y * y), -a * x * z, c * (x * x - y * y)]
    if count > 9:
        a, b, c, d, e = SH_C3
        values += [
            -a * y * (3 * x * x - y * y),
            b * x * y * z,
            -c * y * (4 * z * z - x * x - y * y),
            d * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -c * x * (4 * z * z - x * x - y * y),
            e * z * (x * x - y * y),
            -a * x * (x * x - 3 * y * y),
        ]
    return torch.stack(values, dim=-1)


def colours(sh: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """RGB of Gaussians seen along ``directions``: max(0, 1/2 + sum_k Y_k sh_k).

    Args:
        sh: (G, K, 3) coefficients.
        directions: (..., G, 3) unit vectors.

    Returns:
        (..., G, 3)
    """
    return (torch.einsum("...gk,gkc->...gc", basis(directions, sh.shape[-2]), sh) + 0.5).clamp_min(0.0)


def rgb_to_sh0(rgb: torch.Tensor) -> torch.Tensor:
    """Degree-0 coefficient of a view-independent colour in [0, 1]."""
    return (rgb - 0.5) / SH_C0


def sh0_to_rgb(sh0: torch.Tensor) -> torch.Tensor:
    """View-independent colour of a degree-0 coefficient."""
    return sh0 * SH_C0 + 0.5


def rotated(sh: torch.Tensor, rotations: torch.Tensor) -> torch.Tensor:
    """Coefficients after a rotation R: the new colours along R d are the old ones along d.

    A rotation mixes harmonics of the same degree, so the coefficients follow exactly from the values in enough
    directions: Y sh' = Y(R^T .) sh, solved with the pseudo-inverse of Y.

    Args:
        sh: (G, K, 3) coefficients.
        rotations: (G, 3, 3), or (3, 3) for all.

    Returns:
        (G, K, 3)
    """
    count = sh.shape[-2]
    if count == 1:
        return sh
    index = torch.arange(4 * count, dtype=sh.dtype, device=sh.device) + 0.5
    angle, z = math.pi * (1 + math.sqrt(5)) * index, 1 - index / (2 * count)  # Fibonacci lattice
    radius = (1 - z * z).sqrt()
    directions = torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=-1)
    solve = torch.linalg.pinv(basis(directions, count))
    return solve @ (basis(directions @ rotations, count) @ sh)
