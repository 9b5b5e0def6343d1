"""Interpolation of the motion of anchors at nearby points."""

import warnings

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuma_lib.errors import InputError

FLATNESS = 1e-5
"""Share of the isotropic part added to the moments of the anchors, which regularises the fit to coplanar anchors."""


class Interpolation:
    """Positions and deformation gradients of points, linear in the displacements u of their nearest anchors.

    The weights w_j ~ 1 / sqrt(distance) are those of Spring-Gaus, which shifts a Gaussian by sum_j w_j u_j without
    rotating or stretching its offset from the anchors. Here the weights fit an affine motion, u(X) = sum_j w_j u_j +
    H (X - sum_j w_j X_j), so that points rotate and stretch with their anchors. The deformation gradient is F = I + H.

    Args:
        points: positions at rest [m], shape (N, 3).
        anchors: positions at rest [m], shape (A, 3).
        neighbours: number of anchors per point.

    Raises:
        InputError: fewer than four anchors.
    """

    def __init__(self, points: Tensor, anchors: Tensor, neighbours: int):
        X, P = (value.detach().to("cpu", torch.float64).numpy() for value in (anchors, points))
        count = min(neighbours, len(X))
        if count < 4:
            raise InputError("springs", f"{count} anchors per point must be at least 4")
        distance, index = cKDTree(X).query(P, k=count)
        weights = 1 / np.sqrt(np.maximum(distance, 1e-9))
        weights /= weights.sum(1, keepdims=True)
        centre = np.einsum("nk,nka->na", weights, X[index])
        arms = X[index] - centre[:, None]
        moments = np.einsum("nk,nka,nkb->nab", weights, arms, arms)
        moments += FLATNESS * np.trace(moments, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        slopes = np.linalg.solve(moments, (weights[..., None] * arms).swapaxes(1, 2))  # (N, 3, K)
        shifts = weights + np.einsum("nak,na->nk", slopes, P - centre)
        rows = np.concatenate([shifts[:, None], slopes], 1)  # (N, 4, K)
        columns = np.broadcast_to(index[:, None], rows.shape)
        self.points, self.anchors = points, anchors
        self._matrices = _compressed(
            rows.reshape(4 * len(P), count), columns.reshape(4 * len(P), count), len(X), points
        )

    def __call__(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Positions (T, N, 3) [m] and deformation gradients (T, N, 3, 3) for anchors at x (T, A, 3) [m]."""
        u = self._interpolate(x - self.anchors)
        eye = torch.eye(3, dtype=x.dtype, device=x.device)
        return self.points + u[:, :, 0], eye + u[:, :, 1:].mT

    def velocities(self, v: Tensor) -> Tensor:
        """Velocities of the points (T, N, 3) [m/s] for those of the anchors (T, A, 3)."""
        return self._interpolate(v)[:, :, 0]

    def _interpolate(self, u: Tensor) -> Tensor:
        """Values and gradients, shape (T, N, 4, 3), for values u (T, A, 3) at the anchors."""
        flat = _Product.apply(u.transpose(0, 1).reshape(len(self.anchors), -1), *self._matrices)
        return flat.reshape(len(self.points), 4, len(u), 3).permute(2, 0, 1, 3)


class _Product(torch.autograd.Function):
    """Product of a sparse and a dense matrix, with the transpose of the former for the gradient."""

    @staticmethod
    def forward(ctx, dense: Tensor, matrix: Tensor, transposed: Tensor) -> Tensor:
        ctx.transposed = transposed
        return matrix @ dense

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None]:
        return ctx.transposed @ grad.contiguous(), None, None


def _compressed(values: np.ndarray, columns: np.ndarray, width: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """A matrix with equally many entries per row, and its transpose, in CSR format."""
    height, count = values.shape
    place = torch.stack([torch.arange(height).repeat_interleave(count), torch.tensor(columns.ravel())])
    options = dict(dtype=like.dtype, device=like.device, check_invariants=False)
    with warnings.catch_warnings(action="ignore"):  # torch warns that CSR support is in beta
        return tuple(
            torch.sparse_coo_tensor(entries, values.ravel(), shape, **options).coalesce().to_sparse_csr()
            for entries, shape in ((place, (height, width)), (place.flip(0), (width, height)))
        )
