"""Static equilibrium of a clamped elastic body under a uniform acceleration, and its derivatives.

Find positions x with the internal forces f(x) equal to the load rho a, where f is the integral of P(F) : grad N over
the undeformed body. Newton's method solves it with the consistent tangent of the law, K = df/dx. At a solution the
derivative of x by any parameter of the load follows from the implicit function theorem, K dx = df_load, with the
factors of K that are there already.

Quadratic hexahedra (`neuma_lib.sim.hexahedra`) are used instead of the particles of `neuma_lib.sim.rollout`: the
equilibrium of a nearly incompressible beam is reached in a second instead of after seconds of damped motion, clamps end
exactly at a face, and a second mesh measures the error of discretisation.
"""

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
from neuma_lib.sim.hexahedra import NODES, GaussPoints, Hexahedra

Array = NDArray[np.float64]

TOLERANCE = 1e-6
"""Largest residual force in units of the norm of the load."""
ORDER = 1.4
"""Order of convergence with the size of elements. It is that of the stress at the edges of a clamp, which is singular,
and not of the elements: the tip of the silicone beam (docs/results/silicone.md) drops by 60.75, 61.48 and 61.75 mm with
elements of 30, 15 and 7.5 mm."""
_ITERATIONS = 20  # of Newton's method, before a smaller load is tried
_ROUGH_TOLERANCE = 1e-3  # of increments before the last
_FIRST_INCREMENT, _MIN_INCREMENT = 0.25, 1e-3  # of the load
_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """A body at rest.

    Attributes:
        x: positions of the nodes [m], shape (N, 3).
        load: forces of gravity and of what holds the body on the nodes [N], shape (N, 3).
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
    forces: Array | None = None,
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
        forces: further forces on the nodes (N, 3) [N], such as those that hold the body before a release.

    Raises:
        InputError: no node is clamped, or all are.
        NonFiniteError: there is no equilibrium that the increments reach.
    """
    free = ~clamped_nodes(body, clamps)
    load = density * body.node_volumes[:, None] * np.asarray(gravity, dtype=np.float64)
    if forces is not None:
        load = load + forces
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
            problem = "contains no element of the body"
            raise InputError(f"clamps[{index}]", problem, f"The body occupies {span} m")
        result |= held
    if not result.any() or result.all():
        problem = "hold the whole body" if result.any() else "are missing, and nothing holds the body"
        raise InputError("clamps", problem, "Give a region that contains a part of the body")
    return result


@dataclass(frozen=True, eq=False)
class Forces:
    """Internal forces of a body.

    Attributes:
        total: on the nodes [N], shape (N, 3).
        tangent: derivatives of the elements' forces by their displacements [N/m], shape (E, 81, 81).
        pressure: tr(tau) / 3 at the reduced points [Pa], shape (E, 8).
        slope: its derivative by F [Pa], shape (E, 8, 3, 3).
        volume: smallest determinant of F. Where it is not positive, the rest is not computed.
    """

    total: Array
    tangent: Array
    pressure: Array
    slope: Array
    volume: float


def internal_forces(body: Hexahedra, law: Law, x: Array, pressure: Array | None = None) -> Forces:
    """Internal forces at positions x (N, 3) [m] with selective integration: the deviatoric part of tau is integrated
    with 27 points an element, the pressure with 8.

    Args:
        pressure: that of the geometric part of the tangent (E, 8) [Pa]; None: that of x.
    """
    F = {
        points: np.einsum("eai,eqaj->eqij", x[body.cells], points.gradients, optimize=True)
        for points in (body.full, body.reduced)
    }
    volume = min(float(np.linalg.det(each).min()) for each in F.values())
    if not volume > 0:
        none = np.empty(0)
        return Forces(none, none, none, none, volume)
    inverse, P, C = _stress(law, F[body.full])
    p, slope = _pressure(F[body.full], P, C)
    spherical, spherical_slope = _spherical(inverse, p, p, slope)
    forces, tangent = _integral(body.full, P - spherical, C - spherical_slope)
    inverse, P, C = _stress(law, F[body.reduced])
    p, slope = _pressure(F[body.reduced], P, C)
    parts = _integral(body.reduced, *_spherical(inverse, p, p if pressure is None else pressure, slope))
    total = np.zeros_like(x)
    np.add.at(total, body.cells, forces + parts[0])
    return Forces(total, tangent + parts[1], p, slope, volume)


def _stress(law: Law, F: Array) -> tuple[Array, Array, Array]:
    """F^-T and P (E, Q, 3, 3), and the derivative of P by F (E, Q, 3, 3, 3, 3) [Pa]."""
    given = torch.from_numpy(F.reshape(-1, 3, 3))
    P, C = law.first_piola(given).detach().numpy(), law.tangent(given).numpy()
    return np.linalg.inv(F).swapaxes(2, 3), P.reshape(F.shape), C.reshape(*F.shape, 3, 3)


def _pressure(F: Array, P: Array, C: Array) -> tuple[Array, Array]:
    """tr(tau) / 3 = P : F / 3 (E, Q), and its derivative by F (E, Q, 3, 3)."""
    turned = (F.reshape(*F.shape[:2], 1, 9) @ C.reshape(*F.shape[:2], 9, 9)).reshape(F.shape)
    return (P * F).sum(axis=(2, 3)) / 3, (turned + P) / 3


def _spherical(inverse: Array, p: Array, geometric: Array, slope: Array) -> tuple[Array, Array]:
    """p F^-T (E, Q, 3, 3) and its derivative by F (E, Q, 3, 3, 3, 3), with ``geometric`` in place of p where F^-T is
    differentiated."""
    shape = *p.shape, 3, 3, 3, 3
    outer = (inverse.reshape(*p.shape, 9, 1) * slope.reshape(*p.shape, 1, 9)).reshape(shape)
    turned = np.einsum("eqil,eqkj->eqijkl", geometric[..., None, None] * inverse, inverse)
    return p[..., None, None] * inverse, outer - turned


def _integral(points: GaussPoints, P: Array, C: Array) -> tuple[Array, Array]:
    """The elements' forces (E, 27, 3) and tangents (E, 81, 81) of a stress and its derivative at points."""
    G, w, count = points.gradients, points.weights, len(points.weights)
    scaled = w[..., None, None] * G  # (E, Q, 27, 3)
    forces = np.einsum("eqaj,eqij->eai", scaled, P, optimize=True)
    # K_aibk = sum_qjl w G_aj C_ijkl G_bl as products of matrices
    right = C.reshape(*w.shape, 27, 3) @ G.swapaxes(2, 3)  # (E, Q, i j k, b)
    right = right.reshape(*w.shape, 3, 3, 3 * NODES).swapaxes(2, 3)  # (E, Q, j, i, k b)
    left = scaled.transpose(0, 2, 1, 3).reshape(count, NODES, -1)  # (E, a, Q j)
    tangent = (left @ right.reshape(count, -1, 9 * NODES)).reshape(count, NODES, 3, 3, NODES)
    return forces, tangent.swapaxes(3, 4).reshape(count, 3 * NODES, 3 * NODES)


def _newton(
    body: Hexahedra, law: Law, load: Array, free: NDArray, x: Array, tolerance: float
) -> Equilibrium | None:
    """Newton's method from positions x; None if it does not converge to a body without inverted elements.

    A linear step of a part that turns by an angle changes its volume by the square of the angle, and the pressure that
    follows would dominate the tangent. The tangent therefore has the pressure that the last step predicted linearly,
    as if the pressure were a separate unknown (Magisano, Leonardi and Garcea 2017). Both agree at the solution.
    """
    size = float(np.linalg.norm(load[free])) or 1.0
    number = np.full(len(x), -1)
    number[free] = np.arange(free.sum())
    own = np.where(number[body.cells][..., None] < 0, -1, 3 * number[body.cells][..., None] + np.arange(3))
    rows, columns = np.broadcast_arrays(own.reshape(-1, 3 * NODES, 1), own.reshape(-1, 1, 3 * NODES))
    kept = (rows >= 0) & (columns >= 0)
    pattern, count = (rows[kept], columns[kept]), 3 * int(free.sum())
    pressure = None
    for _ in range(_ITERATIONS):
        forces = internal_forces(body, law, x, pressure)
        if not forces.volume > 0:
            return None
        rest = (load - forces.total)[free]
        residual = float(np.linalg.norm(rest)) / size
        matrix = coo_matrix((forces.tangent[kept], pattern), (count, count)).tocsc()
        try:
            factors = splu(matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options={"SymmetricMode": True})
        except RuntimeError:  # singular
            return None
        if residual < tolerance:
            return Equilibrium(x, load, free, factors, residual)
        step = np.zeros_like(x)
        step[free] = factors.solve(rest.ravel()).reshape(-1, 3)
        change = np.einsum("eai,eqaj->eqij", step[body.cells], body.reduced.gradients, optimize=True)
        pressure = forces.pressure + (forces.slope * change).sum(axis=(2, 3))
        x = x + step
    return None
