"""Move the vertices of a mesh with the particles inside it.

Moving least squares on positions: every vertex is a fixed linear combination of the particles around it at rest, with
coefficients that reproduce affine motions exactly. The elastic deformation gradient is not used, because it excludes
the plastic part of the motion.
"""

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from neuma_lib.errors import InputError

# of a vertex. The farthest has no weight, so that coefficients are continuous along the surface.
_NEIGHBOURS = 32


def skinning_matrix(vertices: np.ndarray, particles: np.ndarray) -> csr_matrix:
    """Coefficients that move vertices with particles.

    Args:
        vertices: rest positions [m], shape (n, 3).
        particles: rest positions of the particles that fill the body [m], shape (N, 3).

    Returns:
        Matrix (n, N) with rows that sum to 1; ``matrix @ x_t`` are the vertices at time t. It maps rest particles to
        rest vertices, and reproduces affine motions A p + b of the particles.

    Raises:
        InputError: fewer particles than needed for an affine fit.
    """
    vertices, particles = np.asarray(vertices, dtype=np.float64), np.asarray(particles, dtype=np.float64)
    if len(particles) < 8:
        raise InputError("skinning: particles", f"{len(particles)} are too few, at least 8 are needed")
    k = min(_NEIGHBOURS, len(particles) - 1)
    distance, index = cKDTree(particles).query(vertices, k=k + 1)
    radius = distance[:, -1:]
    ratio = distance[:, :k] / radius
    weight = (1.0 - ratio) ** 4 * (4.0 * ratio + 1.0)
    index = index[:, :k]
    # shape functions phi_j = w_j (1, 0, 0, 0) M^-1 p_j with p_j = (1, (X_j - v) / radius), M = sum_j w_j p_j p_j^T
    basis = np.concatenate(
        [np.ones((len(vertices), k, 1)), (particles[index] - vertices[:, None]) / radius[..., None]], axis=2
    )
    moment = np.einsum("vk,vki,vkj->vij", weight, basis, basis)
    solution = np.linalg.solve(moment, np.broadcast_to(np.eye(4)[:, :1], (len(vertices), 4, 1)))[..., 0]
    phi = weight * np.einsum("vki,vi->vk", basis, solution)
    start = np.arange(len(vertices) + 1) * k
    return csr_matrix((phi.ravel(), index.ravel(), start), shape=(len(vertices), len(particles)))


def carry(matrix: csr_matrix, x: np.ndarray) -> np.ndarray:
    """Vertices (T, n, 3) [m] for particle positions x (T, N, 3) [m]."""
    return np.stack([matrix @ np.asarray(frame, dtype=np.float64) for frame in x])
