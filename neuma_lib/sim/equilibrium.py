"""Static equilibrium of a clamped elastic body under a uniform acceleration, and its derivatives.

Find positions x with the internal forces f(x) equal to the load rho a, where f is the integral of P(F) : grad N over
the undeformed body. Newton's method solves it with the consistent tangent of the law, K = df/dx. At a solution the
derivative of x by any parameter of the load follows from the implicit function theorem, K dx = df_load, with the
factors of K that are there already.

Quadratic hexahedra (`neuma_lib.sim.hexahedra`) are used instead of the particles of `neuma_lib.sim.rollout`: the
equilibrium of a nearly incompressible beam is reached in a second instead of after seconds of damped motion, clamps end
exactly at a face, and a second mesh measures the error of discretisation.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import SuperLU, splu

from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.hexahedra import NODES, Hexahedra

Array = NDArray[np.float64]

TOLERANCE = 1e-8
"""Largest residual force in units of the norm of the load."""
ORDER = 1.4
"""Order of convergence with the size of elements. It is that of the stress at the edges of a clamp, which is singular,
and not of the elements: the tip of the silicone beam (docs/results/silicone.md) drops by 60.75, 61.48 and 61.75 mm with
elements of 30, 15 and 7.5 mm."""
_ITERATIONS = 12  # of Newton's method, before a smaller load is tried
_ROUGH_TOLERANCE = 1e-3  # of increments before the last
_MAX_GROWTH = (
    1e4  # of the residual within an increment, since it rises by orders of magnitude where a body turns
)
_FIRST_INCREMENT, _MIN_INCREMENT = 0.25, 1e-3  # of the load
_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """A body at rest.

    Attributes:
        x: positions of the nodes [m], shape (N, 3).
        load: forces of gravity on the nodes [N], shape (N, 3).
        free: whether a node moves, shape (N,).
        factors: of the tangent in the free displacements.
        residual: norm of the forces that remain, in units of the load.
    """

    x: Array
    load: Array
    free: NDArray[np.bool_]
    factors: SuperLU
    residual: float

    def response(self, forces: Array) -> Array:
        """Displacements (N, 3) [m] of small additional forces (N, 3) [N] on the nodes."""
        result = np.zeros_like(self.x)
        result[self.free] = self.factors.solve(forces[self.free].ravel()).reshape(-1, 3)
        return result

    @property
    def by_stiffness(self) -> Array:
        """Derivative (N, 3) [m] of the positions by the logarithm of all moduli at once, with constant density."""
        return -self.response(self.load)


def solve_equilibrium(
    body: Hexahedra,
    law: Law,
    density: float,
    gravity: Sequence[float] | Array,
    clamps: Sequence[Clamp],
    start: Array | None = None,
) -> Equilibrium:
    """Positions of a body at rest.

    The load is applied in increments, each the start of the next, since Newton's method does not converge from the
    undeformed body if it bends far.

    Args:
        body: the undeformed body.
        law: its elasticity; of a law with plasticity the elastic response.
        density: [kg/m^3].
        gravity: acceleration [m/s^2], shape (3,).
        clamps: regions that are held in place.
        start: positions (N, 3) [m] near the solution, for example with slightly different constants.

    Raises:
        InputError: no node is clamped, or all are.
        NonFiniteError: there is no equilibrium that the increments reach.
    """
    free = ~clamped_nodes(body, clamps)
    load = density * body.node_volumes[:, None] * np.asarray(gravity, dtype=np.float64)
    if start is not None:
        x = np.where(free[:, None], start, body.nodes)
        if (solution := _newton(body, law, load, free, x, TOLERANCE)) is not None:
            return solution
    reached, increment, x = 0.0, _FIRST_INCREMENT, body.nodes
    while True:
        share = min(1.0, reached + increment)
        tolerance = TOLERANCE if share == 1 else _ROUGH_TOLERANCE
        attempt = _newton(body, law, share * load, free, x, tolerance)
        if attempt is not None:
            _LOGGER.debug("equilibrium under %.4g of the load", share)
            if share == 1:
                return attempt
            reached, x, increment = share, attempt.x, 2 * increment
        elif (increment := increment / 2) < _MIN_INCREMENT:
            detail = f"Newton's method fails beyond {reached:.3g} of the load. Is the body much too soft?"
            raise NonFiniteError("equilibrium", detail)


def extrapolated(coarse: float, fine: float, ratio: float) -> float:
    """A value for infinitely small elements, from two meshes whose sizes of elements have a ratio above 1."""
    return fine + (fine - coarse) / (ratio**ORDER - 1)


def clamped_nodes(body: Hexahedra, clamps: Sequence[Clamp]) -> NDArray[np.bool_]:
    """Which nodes are in a clamp, faces included, shape (N,).

    Raises:
        InputError: a clamp contains no element, or there is no free node.
    """
    slack = 1e-6 * np.ptp(body.nodes, axis=0).max()
    result = np.zeros(len(body.nodes), dtype=bool)
    for index, clamp in enumerate(clamps):
        low, high = np.array(clamp.lowest) - slack, np.array(clamp.highest) + slack
        held = ((body.nodes >= low) & (body.nodes <= high)).all(axis=1)
        if not held[body.cells].all(axis=1).any():
            span = ", ".join(f"{a:.3g} to {b:.3g}" for a, b in zip(body.nodes.min(0), body.nodes.max(0)))
            raise InputError(
                f"clamps[{index}]", "contains no element of the body", f"The body occupies {span} m"
            )
        result |= held
    if not result.any() or result.all():
        problem = "hold the whole body" if result.any() else "are missing, and nothing holds the body"
        raise InputError("clamps", problem, "Give a region that contains a part of the body")
    return result


def internal_forces(body: Hexahedra, law: Law, x: Array) -> tuple[Array, Array, float]:
    """Internal forces at positions x (N, 3) [m] with selective integration: the deviatoric part of tau is integrated
    with 27 points an element, the pressure with 8.

    Returns:
        Forces (N, 3) [N], the elements' tangents (E, 81, 81) [N/m], and the smallest determinant of F.
    """
    shape = len(body.cells), NODES, 3 * 3 * NODES
    forces, tangent, smallest = np.zeros((*shape[:2], 3)), np.zeros(shape), np.inf
    for points, part in ((body.full, _deviatoric), (body.reduced, _spherical)):
        F = np.einsum("eai,eqaj->eqij", x[body.cells], points.gradients, optimize=True).reshape(-1, 3, 3)
        smallest = min(smallest, float(np.linalg.det(F).min()))
        if not smallest > 0:
            return np.full_like(x, np.nan), np.empty(0), smallest
        given = torch.from_numpy(F)
        P, C = part(F, law.first_piola(given).detach().numpy(), law.tangent(given).numpy())
        G, w = points.gradients, points.weights
        scaled = w[..., None, None] * G  # (E, Q, 27, 3)
        forces += np.einsum("eqaj,eqij->eai", scaled, P.reshape(*w.shape, 3, 3), optimize=True)
        # K_aibk = sum_qjl w G_aj C_ijkl G_bl as products of matrices
        right = C.reshape(*w.shape, 27, 3) @ G.swapaxes(2, 3)  # (E, Q, i j k, b)
        right = right.reshape(*w.shape, 3, 3, 3 * NODES).swapaxes(2, 3)  # (E, Q, j, i, k b)
        left = scaled.transpose(0, 2, 1, 3).reshape(len(w), NODES, -1)  # (E, a, Q j)
        tangent += left @ right.reshape(len(w), -1, 9 * NODES)
    tangent = tangent.reshape(-1, NODES, 3, 3, NODES).swapaxes(3, 4).reshape(-1, 3 * NODES, 3 * NODES)
    total = np.zeros_like(x)
    np.add.at(total, body.cells, forces)
    return total, tangent, smallest


def _spherical(F: Array, P: Array, C: Array) -> tuple[Array, Array]:
    """The part p F^-T of P with p = tr(tau) / 3 = P : F / 3, (M, 3, 3), and its derivative by F (M, 3, 3, 3, 3)."""
    inverse = np.linalg.inv(F).swapaxes(1, 2)  # F^-T
    p = np.einsum("nij,nij->n", P, F) / 3
    slope = ((F.reshape(-1, 1, 9) @ C.reshape(-1, 9, 9)).reshape(-1, 3, 3) + P) / 3
    outer = inverse.reshape(-1, 9, 1) * slope.reshape(-1, 1, 9)
    turned = np.einsum("nil,nkj->nijkl", p[:, None, None] * inverse, inverse)
    return p[:, None, None] * inverse, outer.reshape(-1, 3, 3, 3, 3) - turned


def _deviatoric(F: Array, P: Array, C: Array) -> tuple[Array, Array]:
    """P without its `_spherical` part, and its derivative."""
    spherical, slope = _spherical(F, P, C)
    return P - spherical, C - slope


def _newton(
    body: Hexahedra, law: Law, load: Array, free: NDArray, x: Array, tolerance: float
) -> Equilibrium | None:
    """Newton's method from positions x; None if it does not converge to a body without inverted elements."""
    size = float(np.linalg.norm(load[free])) or 1.0
    number = np.full(len(x), -1)
    number[free] = np.arange(free.sum())
    own = np.where(number[body.cells][..., None] < 0, -1, 3 * number[body.cells][..., None] + np.arange(3))
    rows, columns = np.broadcast_arrays(own.reshape(-1, 3 * NODES, 1), own.reshape(-1, 1, 3 * NODES))
    kept = (rows >= 0) & (columns >= 0)
    pattern, count = (rows[kept], columns[kept]), 3 * int(free.sum())
    start = np.inf
    for _ in range(_ITERATIONS):
        forces, elements, volume = internal_forces(body, law, x)
        residual = float(np.linalg.norm((load - forces)[free])) / size
        start = min(start, residual)
        if not (volume > 0 and residual < _MAX_GROWTH * max(start, 1.0)):
            return None
        matrix = coo_matrix((elements[kept], pattern), (count, count)).tocsc()
        try:
            factors = splu(matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options={"SymmetricMode": True})
        except RuntimeError:  # singular
            return None
        if residual < tolerance:
            return Equilibrium(x, load, free, factors, residual)
        x = x.copy()
        x[free] += factors.solve((load - forces)[free].ravel()).reshape(-1, 3)
    return None
