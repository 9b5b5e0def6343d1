"""Kernels of :mod:`neuma_lib.methods.pac_nerf.lattice`: nodes to points and points to nodes, with adjoints.

They use the eight nodes around a point with the weights of trilinear interpolation. The channels of a node form one
vector.
"""

# No `from __future__ import annotations` here: Warp reads the annotations of kernels as objects.
import functools
from types import SimpleNamespace

import torch
import warp as wp

from neuma_lib.device import start_warp

start_warp()


@functools.cache
def lattice_types(dtype: torch.dtype) -> SimpleNamespace:
    """Warp's types for a torch precision, and the struct of the lattice."""
    real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
    types = SimpleNamespace(real=real, vec3=wp.types.vector(length=3, dtype=real))

    @wp.struct
    class Place:
        origin: types.vec3  # position of node (0, 0, 0) [m]
        inv_voxel: real  # [1/m]
        nodes: wp.vec3i  # along each axis, the last index is contiguous

    types.Place = Place
    return types


@functools.cache
def lattice_functions(dtype: torch.dtype) -> SimpleNamespace:
    """Functions shared by kernels on lattices: cell of a point, position in the cell, and weights."""
    t = lattice_types(dtype)
    real, vec3, Place = t.real, t.vec3, t.Place

    @wp.func
    def cell(place: Place, x: vec3):
        """First of the eight nodes around x, clamped to valid indices."""
        c = wp.vec3i()
        for a in range(3):
            c[a] = wp.clamp(
                wp.int32(wp.floor((x[a] - place.origin[a]) * place.inv_voxel)), 0, place.nodes[a] - 2
            )
        return c

    @wp.func
    def within(place: Place, x: vec3, c: wp.vec3i):
        """Position of x in its cell [voxels], in [0, 1] for points within the lattice."""
        f = (x - place.origin) * place.inv_voxel
        return vec3(f[0] - real(c[0]), f[1] - real(c[1]), f[2] - real(c[2]))

    @wp.func
    def share(f: real, far: wp.int32):
        """Weight of the near (0) or far (1) node along one axis."""
        return wp.where(far == 1, f, real(1.0) - f)

    @wp.func
    def slope(far: wp.int32):
        """Derivative of `share` with respect to f."""
        return wp.where(far == 1, real(1.0), real(-1.0))

    @wp.func
    def row(place: Place, c: wp.vec3i, i: wp.int32, j: wp.int32):
        """Index of the node (i, j, 0) of a cell."""
        return ((c[0] + i) * place.nodes[1] + c[1] + j) * place.nodes[2] + c[2]

    return SimpleNamespace(cell=cell, within=within, share=share, slope=slope, row=row)


@functools.cache
def kernels(dtype: torch.dtype, channels: int) -> SimpleNamespace:
    """Kernels `read`, `read_adjoint`, `deposit` and `deposit_adjoint` over points, and `normalise` over nodes."""
    t, functions = lattice_types(dtype), lattice_functions(dtype)
    real, vec3, Place = t.real, t.vec3, t.Place
    cell, within, share, slope, row = vars(functions).values()
    vec = wp.types.vector(length=channels, dtype=real)
    module = wp.get_module(f"{__name__}.{str(dtype).removeprefix('torch.')}_{channels}")
    kernel = functools.partial(wp.kernel, enable_backward=False, module=module)

    @kernel
    def read(place: Place, values: wp.array(dtype=vec), x: wp.array(dtype=vec3), out: wp.array(dtype=vec)):
        """out = sum_n w_n values_n."""
        p = wp.tid()
        c = cell(place, x[p])
        f = within(place, x[p], c)
        total = vec()
        for i in range(2):
            for j in range(2):
                n, w = row(place, c, i, j), share(f[0], i) * share(f[1], j)
                total += (w * (real(1.0) - f[2])) * values[n] + (w * f[2]) * values[n + 1]
        out[p] = total

    @kernel
    def read_adjoint(
        place: Place, x: wp.array(dtype=vec3), grad_out: wp.array(dtype=vec), grad_values: wp.array(dtype=vec)
    ):
        """grad_values_n += w_n grad_out."""
        p = wp.tid()
        c = cell(place, x[p])
        f = within(place, x[p], c)
        g = grad_out[p]
        for i in range(2):
            for j in range(2):
                n, w = row(place, c, i, j), share(f[0], i) * share(f[1], j)
                wp.atomic_add(grad_values, n, (w * (real(1.0) - f[2])) * g)
                wp.atomic_add(grad_values, n + 1, (w * f[2]) * g)

    @kernel
    def deposit(
        place: Place,
        x: wp.array(dtype=vec3),
        features: wp.array(dtype=vec),
        weights: wp.array(dtype=real),
        sums: wp.array(dtype=vec),
    ):
        """weights_n += w_n,  sums_n += w_n features."""
        p = wp.tid()
        c = cell(place, x[p])
        f = within(place, x[p], c)
        value = features[p]
        for i in range(2):
            for j in range(2):
                n, w = row(place, c, i, j), share(f[0], i) * share(f[1], j)
                near, far = w * (real(1.0) - f[2]), w * f[2]
                wp.atomic_add(weights, n, near)
                wp.atomic_add(sums, n, near * value)
                wp.atomic_add(weights, n + 1, far)
                wp.atomic_add(sums, n + 1, far * value)

    @kernel
    def normalise(least: real, empty: real, weights: wp.array(dtype=real), values: wp.array(dtype=vec)):
        """In place: sums to means, and `empty` where the sum of weights is at most `least`."""
        n = wp.tid()
        if weights[n] > least:
            values[n] = values[n] / weights[n]
        else:
            for channel in range(wp.static(channels)):
                values[n][channel] = empty

    @kernel
    def deposit_adjoint(
        place: Place,
        least: real,
        x: wp.array(dtype=vec3),
        features: wp.array(dtype=vec),
        weights: wp.array(dtype=real),
        means: wp.array(dtype=vec),
        grad_means: wp.array(dtype=vec),
        grad_x: wp.array(dtype=vec3),
        grad_features: wp.array(dtype=vec),
    ):
        """With m = sum w f / sum w: dm/df = w / sum w, dm/dw = (f - m) / sum w, and dw/dx = w' / voxel."""
        p = wp.tid()
        c = cell(place, x[p])
        f = within(place, x[p], c)
        value = features[p]
        g_x, g_f = vec3(), vec()
        for i in range(2):
            for j in range(2):
                for k in range(2):
                    n = row(place, c, i, j) + k
                    if weights[n] > least:
                        wi, wj, wk = share(f[0], i), share(f[1], j), share(f[2], k)
                        g = grad_means[n] / weights[n]
                        g_f += (wi * wj * wk) * g
                        g_w = wp.dot(g, value - means[n])
                        g_x += g_w * vec3(slope(i) * wj * wk, wi * slope(j) * wk, wi * wj * slope(k))
        grad_x[p] = place.inv_voxel * g_x
        grad_features[p] = g_f

    return SimpleNamespace(
        read=read,
        read_adjoint=read_adjoint,
        deposit=deposit,
        normalise=normalise,
        deposit_adjoint=deposit_adjoint,
    )
