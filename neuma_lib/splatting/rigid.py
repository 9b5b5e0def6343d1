"""Similarity transformations of Gaussians."""

import dataclasses
import math

import torch

from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.spherical_harmonics import basis


def moved(
    gaussians: Gaussians, rotation: torch.Tensor, translation: torch.Tensor, scale: float = 1.0
) -> Gaussians:
    """Gaussians transformed by x -> s R x + t, with R (3, 3) and t (3,) [m], including their harmonics."""
    R, t = rotation.to(gaussians.means), translation.to(gaussians.means)
    quats = _product(_quaternion(R), torch.nn.functional.normalize(gaussians.quats, dim=-1))
    sh = rotated(gaussians.sh(), rotation)
    means, scales = scale * gaussians.means @ R.mT + t, scale * gaussians.scales
    return dataclasses.replace(
        gaussians, means=means, scales=scales, quats=quats, sh0=sh[:, :1], shN=sh[:, 1:]
    )


def rotated(sh: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
    """Harmonics (G, K, 3) after a rotation R (3, 3): the new values along R d are the old ones along d.

    A rotation mixes harmonics of the same degree. The mixing matrix is the least-squares solution for values in evenly
    distributed directions.
    """
    count = sh.shape[-2]
    k = torch.arange(64, dtype=torch.float64) + 0.5
    up, around = 1 - k / 32, math.pi * (1 + math.sqrt(5)) * k
    level = (1 - up * up).sqrt()
    directions = torch.stack([level * around.cos(), level * around.sin(), up], dim=-1)
    turned = basis(directions @ rotation.double().cpu(), count)  # along R^T d
    mixed = torch.linalg.lstsq(basis(directions, count), turned).solution
    return mixed.to(sh) @ sh


def _quaternion(R: torch.Tensor) -> torch.Tensor:
    """Unit quaternion (4,), w first, of a rotation (3, 3) with any angle, as an eigenvector (Bar-Itzhack 2000)."""
    m = R.double().cpu()
    xx, yy, zz = m.diagonal()
    K = torch.zeros(4, 4, dtype=torch.float64)  # order (x, y, z, w)
    K[0, 0], K[1, 1], K[2, 2], K[3, 3] = xx - yy - zz, yy - xx - zz, zz - xx - yy, xx + yy + zz
    K[0, 1], K[0, 2], K[1, 2] = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    K[0, 3], K[1, 3], K[2, 3] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xyzw = torch.linalg.eigh(K, UPLO="U")[1][:, -1]
    return xyzw.roll(1).to(R)


def _product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Products (..., 4) of quaternions, w first: the rotation b, then the rotation a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    values = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
    return torch.stack(values, dim=-1)
