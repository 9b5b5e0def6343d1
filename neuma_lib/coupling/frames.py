"""The Gaussians of a moving body at one time as standalone Gaussians, for export."""

import dataclasses

import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from neuma_lib.coupling.deformation import arms_at_rest, deform
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.splatting.gaussians import Gaussians, quaternions
from neuma_lib.splatting.spherical_harmonics import rotated

_FLATTEST = 1e-6
"""Minimum ratio of the shortest axis to the longest one; smaller ratios are round-off of a covariance."""


def gaussians_at(body: Reconstruction, x: Tensor, F: Tensor, rotate_harmonics: bool = True) -> Gaussians:
    """Gaussians deformed with the particles, with covariances decomposed into scales and rotations; on the CPU.

    Args:
        body: the body at rest.
        x: (N, 3) particle positions [m].
        F: (N, 3, 3) deformation gradients.
        rotate_harmonics: rotate harmonics by the rotation in the polar decomposition of F_bar = B F.

    Returns:
        Gaussians in the same order, with the body's dtype.
    """
    g, binding = body.gaussians, body.binding
    arms = arms_at_rest(g.means, binding, body.x0) if body.affine else None
    means, covars = deform(g.means, g.covars(), binding, body.x0, x[None], F[None], arms=arms)
    scales, quats = axes_of(covars[0])
    moved = dataclasses.replace(g, means=means[0], scales=scales, quats=quats)
    if not rotate_harmonics or g.shN.shape[1] == 0:
        return moved
    sh = rotated(g.sh().double(), local_rotations(body, F)).to(g.sh0)
    return dataclasses.replace(moved, sh0=sh[:, :1], shN=sh[:, 1:])


def axes_of(covars: Tensor) -> tuple[Tensor, Tensor]:
    """Standard deviations (G, 3), ascending, and quaternions (G, 4) of covariances (G, 3, 3)."""
    values, axes = torch.linalg.eigh(covars.double())
    longest = values[:, -1:].clamp(min=torch.finfo(torch.float32).tiny)
    scales = torch.maximum(values, _FLATTEST**2 * longest).sqrt()
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]  # a proper rotation with the same axes
    return scales.to(covars), quaternions(axes).to(covars)


def local_rotations(body: Reconstruction, F: Tensor) -> Tensor:
    """Rotations (G, 3, 3), float64, closest to F_bar = B F of deformation gradients F (N, 3, 3)."""
    b = body.binding
    matrix = csr_matrix((b.values.double().numpy(), b.indices.numpy(), b.indptr.numpy()), shape=b.shape)
    F_bar = torch.from_numpy(matrix @ F.double().flatten(1).numpy()).unflatten(1, (3, 3))
    F_bar[b.counts == 0] = torch.eye(3, dtype=torch.float64)
    U, _, V = torch.linalg.svd(F_bar)
    U = torch.cat([U[..., :2], U[..., 2:] * torch.linalg.det(U @ V).sign()[:, None, None]], dim=-1)
    return U @ V
