"""Quadratic hexahedra: the mesh of a body for its static equilibrium.

Elements have 27 nodes (triquadratic Lagrange polynomials) and two sets of Gauss points: 27 for the deviatoric stress
and 8 for the pressure. Linear tetrahedra lock: a nearly incompressible body has about as many volume constraints as
displacements, and its stiffness is overestimated severalfold. Here 8 constraints an element face 24 displacements (its
nodes, each shared with neighbours), and quadratic displacements bend without shear. This is selective reduced
integration (Malkus and Hughes 1978). Eight points for all stresses would not do: a row of elements then has
deformations without energy.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from neuma_lib.errors import InputError

Array = NDArray[np.float64]

NODES = 27
"""Nodes of an element."""
SITES = np.array(list(product((-1, 0, 1), repeat=3)))
"""Local coordinates (27, 3) of an element's nodes."""


def gauss(count: int) -> tuple[Array, Array]:
    """Local coordinates (count^3, 3) and weights (count^3,) of Gauss points in [-1, 1]^3."""
    x, w = np.polynomial.legendre.leggauss(count)
    return np.array(list(product(x, repeat=3))), np.array(list(product(w, repeat=3))).prod(axis=1)


def _parabolas(x: Array) -> tuple[Array, Array]:
    """Values and slopes (..., 3) of the quadratic Lagrange polynomials of -1, 0, 1 at x (...)."""
    values = np.stack([x * (x - 1) / 2, 1 - x**2, x * (x + 1) / 2], axis=-1)
    return values, np.stack([x - 0.5, -2 * x, x + 0.5], axis=-1)


def shape_functions(local: Array) -> Array:
    """Values (P, 27) of an element's shape functions at local coordinates (P, 3) in [-1, 1]."""
    one = _parabolas(local)[0]
    return np.einsum("pa,pb,pc->pabc", *one.transpose(1, 0, 2)).reshape(-1, NODES)


def shape_gradients(local: Array) -> Array:
    """Derivatives (P, 27, 3) of `shape_functions` by local coordinates (P, 3)."""
    values, slopes = _parabolas(local)
    result = np.empty((len(local), NODES, 3))
    for axis in range(3):
        one = [(slopes if k == axis else values)[:, k] for k in range(3)]
        result[..., axis] = np.einsum("pa,pb,pc->pabc", *one).reshape(-1, NODES)
    return result


@dataclass(frozen=True, eq=False)
class GaussPoints:
    """Points of integration in E elements.

    Attributes:
        values: of the shape functions, the same in all elements, shape (Q, 27).
        gradients: derivatives of the shape functions by position [1/m], shape (E, Q, 27, 3).
        weights: volumes [m^3], shape (E, Q).
    """

    values: Array
    gradients: Array
    weights: Array


@dataclass(frozen=True, eq=False)
class Hexahedra:
    """A mesh of quadratic hexahedra in the undeformed body.

    Attributes:
        nodes: positions [m], shape (N, 3).
        cells: nodes of the elements in the order of `shape_functions`, shape (E, 27).
    """

    nodes: Array
    cells: NDArray[np.int64]

    @classmethod
    def of_blocks(cls, planes: Sequence[Array], filled: NDArray[np.bool_]) -> "Hexahedra":
        """The mesh of filled blocks of a rectilinear grid, an element each.

        Args:
            planes: ascending coordinates of the grid's planes on each axis [m].
            filled: which blocks the body fills, shape (nx, ny, nz), one less than the planes on each axis.

        Raises:
            InputError: no block is filled.
        """
        blocks = np.argwhere(filled)
        if not len(blocks):
            raise InputError("blocks", "none is filled", "Check the body and its length unit")
        lattice = 2 * blocks[:, None] + 1 + SITES
        shape = tuple(2 * n + 1 for n in filled.shape)
        used, cells = np.unique(
            np.ravel_multi_index(tuple(np.moveaxis(lattice, 2, 0)), shape), return_inverse=True
        )
        with_middles = [
            np.insert(plane, np.arange(1, len(plane)), (plane[1:] + plane[:-1]) / 2) for plane in planes
        ]
        index = np.unravel_index(used, shape)
        nodes = np.stack([coordinates[i] for coordinates, i in zip(with_middles, index, strict=True)], axis=1)
        return cls(nodes, cells.reshape(-1, NODES))

    @cached_property
    def full(self) -> GaussPoints:
        """27 points an element."""
        return self._points(3)

    @cached_property
    def reduced(self) -> GaussPoints:
        """8 points an element."""
        return self._points(2)

    def _points(self, count: int) -> GaussPoints:
        local, weights = gauss(count)
        slopes = shape_gradients(local)
        jacobian = np.einsum("qai,eaj->eqij", slopes, self.nodes[self.cells])
        gradients = np.linalg.solve(jacobian, slopes.transpose(0, 2, 1)[None]).transpose(0, 1, 3, 2)
        return GaussPoints(shape_functions(local), gradients, weights * np.linalg.det(jacobian))

    @cached_property
    def node_volumes(self) -> Array:
        """Integrals of the shape functions [m^3], shape (N,). They sum to the volume."""
        parts = np.einsum("eq,qa->ea", self.full.weights, self.full.values)
        result = np.zeros(len(self.nodes))
        np.add.at(result, self.cells, parts)
        return result

    def at(self, points: Array) -> tuple[csr_matrix, list[csr_matrix]]:
        """Interpolation of values of the nodes at points of the undeformed body.

        Args:
            points: shape (P, 3) [m].

        Returns:
            Weights (P, N) of the nodes, and their derivatives by position on each axis [1/m], three of (P, N).

        Raises:
            InputError: a point is outside the body.
        """
        low, high = self.nodes[self.cells[:, 0]], self.nodes[self.cells[:, -1]]
        slack = 1e-6 * np.ptp(self.nodes, axis=0).max()
        own = (points[:, None] >= low - slack) & (points[:, None] <= high + slack)
        inside = own.all(axis=2)
        if not inside.any(axis=1).all():
            where = ", ".join(f"{value:.4g}" for value in points[~inside.any(axis=1)][0])
            raise InputError("points", f"({where}) m is outside the body")
        cell = inside.argmax(axis=1)
        half = (high - low)[cell] / 2
        local = (points - low[cell]) / half - 1
        slopes = shape_gradients(local) / half[:, None]
        rows, columns = np.repeat(np.arange(len(points)), NODES), self.cells[cell].ravel()
        values = [shape_functions(local), *np.moveaxis(slopes, 2, 0)]
        shape = len(points), len(self.nodes)
        weights, *derivatives = (csr_matrix((own.ravel(), (rows, columns)), shape) for own in values)
        return weights, derivatives

    def surface(self, length: float) -> tuple[csr_matrix, NDArray[np.int64]]:
        """The outer surface as triangles.

        Args:
            length: of the longest edge of a triangle along a side of an element, about [m].

        Returns:
            Weights (P, N) of the nodes in each point of the surface, and the points of the triangles (T, 3), whose
            normals point outwards. Points are shared by neighbouring triangles.
        """
        outer = self._outer_faces()
        points, corners, offset = [], [], 0
        for axis, side in product(range(3), (-1, 1)):
            own = self.cells[outer[axis, side]]
            one, two = ((axis + 1) % 3, (axis + 2) % 3)
            for cell in own:
                extent = np.ptp(self.nodes[cell], axis=0)
                counts = [max(1, int(np.ceil(extent[k] / length - 1e-9))) for k in (one, two)]
                u, v = np.meshgrid(*(np.linspace(-1, 1, n + 1) for n in counts), indexing="ij")
                local = np.empty((u.size, 3))
                local[:, axis], local[:, one], local[:, two] = side, u.ravel(), v.ravel()
                points.append((np.repeat(cell[None], u.size, axis=0), shape_functions(local)))
                corners.append(offset + _grid_triangles(*counts, flipped=side < 0))
                offset += u.size
        nodes, values = (np.concatenate(parts) for parts in zip(*points, strict=True))
        rows = np.repeat(np.arange(offset), NODES)
        weights = csr_matrix((values.ravel(), (rows, nodes.ravel())), (offset, len(self.nodes)))
        weights.data[np.abs(weights.data) < 1e-12] = 0.0
        weights.eliminate_zeros()
        scale = np.ptp(self.nodes, axis=0).max()
        rounded = np.round(weights @ self.nodes / (1e-7 * scale)).astype(np.int64)
        _, first, merged = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
        return weights[first], merged.ravel()[np.concatenate(corners)]

    def _outer_faces(self) -> dict[tuple[int, int], NDArray[np.int64]]:
        """Elements whose side on an axis, -1 or 1, has no neighbour."""
        keys, owners = [], []
        for axis, side in product(range(3), (-1, 1)):
            keys.append(np.sort(self.cells[:, SITES[:, axis] == side], axis=1))
            owners += [(axis, side, cell) for cell in range(len(self.cells))]
        _, index, count = np.unique(np.concatenate(keys), axis=0, return_inverse=True, return_counts=True)
        alone = count[index.ravel()] == 1
        result: dict[tuple[int, int], list[int]] = {key: [] for key in product(range(3), (-1, 1))}
        for (axis, side, cell), single in zip(owners, alone, strict=True):
            if single:
                result[axis, side].append(cell)
        return {key: np.array(cells, dtype=np.int64) for key, cells in result.items()}


def _grid_triangles(m: int, n: int, flipped: bool) -> NDArray[np.int64]:
    """Triangles of a grid of (m + 1) x (n + 1) points in rows, (2 m n, 3)."""
    a = (np.arange(m)[:, None] * (n + 1) + np.arange(n)).ravel()
    b, c, d = a + n + 1, a + n + 2, a + 1
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return triangles[:, ::-1] if flipped else triangles
