"""Kernels of :mod:`neuma_lib.methods.pac_nerf.rendering`: selection of the points of a ray, and compositing."""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from neuma_lib.device import start_warp, typed
from neuma_lib.methods.pac_nerf.lattice import Lattice

start_warp()


@functools.cache
def warp_types(dtype: torch.dtype) -> SimpleNamespace:
    """Warp's types for a torch precision, and the struct of a lattice."""
    real = wp.dtype_from_torch(dtype)
    types = SimpleNamespace(real=real, vec3=wp.types.vector(length=3, dtype=real))

    @wp.struct
    class Place:
        origin: types.vec3  # position of node (0, 0, 0) [m]
        inv_voxel: real  # [1/m]
        nodes: wp.vec3i  # along each axis, the last index is contiguous

    types.Place = Place
    return types


def place_of(lattice: Lattice, dtype: torch.dtype):
    """A lattice as a struct for kernels."""
    t = warp_types(dtype)
    place = t.Place()
    place.origin, place.inv_voxel = t.vec3(*lattice.origin), 1.0 / lattice.voxel
    place.nodes = wp.vec3i(*lattice.nodes)
    return place


@functools.cache
def kernels(dtype: torch.dtype) -> SimpleNamespace:
    """Kernels `march`, `composite` and `composite_adjoint` over rays."""
    t = warp_types(dtype)
    real, vec3, Place = t.real, t.vec3, t.Place
    module = wp.get_module(f"{__name__}.{str(dtype).removeprefix('torch.')}")
    types = {
        "place": Place,
        **dict.fromkeys(("near", "step", "interval", "shift", "least", "end"), real),
        "fill": wp.int32,
        "density": wp.array(dtype=real),
        "background": vec3,
        **dict.fromkeys(("starts", "counts"), wp.array(dtype=wp.int32)),
        "rays": wp.array(dtype=wp.int64),
        **dict.fromkeys(("alphas", "reaching", "passed", "grad_passed", "grad_alphas"), wp.array(dtype=real)),
        **dict.fromkeys("origins directions points colours pictures".split(), wp.array(dtype=vec3)),
        **dict.fromkeys(("grad_pictures", "grad_colours"), wp.array(dtype=vec3)),
    }
    kernel = typed(types).kernel(module)

    @wp.func(module=module)
    def density_at(place: Place, density: wp.array(dtype=real), x: vec3):
        """Trilinear interpolation."""
        at = (x - place.origin) * place.inv_voxel
        c = wp.vec3i()
        for a in range(3):
            c[a] = wp.clamp(wp.int32(wp.floor(at[a])), 0, place.nodes[a] - 2)
        f = vec3(at[0] - real(c[0]), at[1] - real(c[1]), at[2] - real(c[2]))
        total = real(0.0)
        for i in range(2):
            for j in range(2):
                n = ((c[0] + i) * place.nodes[1] + c[1] + j) * place.nodes[2] + c[2]
                w = wp.where(i == 1, f[0], real(1.0) - f[0]) * wp.where(j == 1, f[1], real(1.0) - f[1])
                total += w * ((real(1.0) - f[2]) * density[n] + f[2] * density[n + 1])
        return total

    @wp.func(module=module)
    def opacity(density: real, interval: real, shift: real):
        """1 - (1 + exp(d + shift))^-interval, without overflow."""
        s = density + shift
        softplus = wp.max(s, real(0.0)) + wp.log(real(1.0) + wp.exp(-wp.abs(s)))
        return real(1.0) - wp.exp(-interval * softplus)

    @kernel
    def march(
        place, near, step, interval, shift, least, end, fill, density, origins, directions, starts, points, rays,
        counts,
    ):  # fmt: skip
        """Select points of a ray with a weight T alpha above `least`, until the transmittance T is below `end`.

        Counts the points, or writes them from `starts` on if `fill` is 1. Both passes select the same points.
        """
        r = wp.tid()
        o, d = origins[r], directions[r]
        first, last = near, real(1.0e30)
        for a in range(3):
            low, high = place.origin[a], place.origin[a] + real(place.nodes[a] - 1) / place.inv_voxel
            if wp.abs(d[a]) > real(1.0e-12):
                one, other = (low - o[a]) / d[a], (high - o[a]) / d[a]
                first, last = wp.max(first, wp.min(one, other)), wp.min(last, wp.max(one, other))
            elif o[a] < low or o[a] > high:
                last = real(-1.0)
        transmitted = real(1.0)
        count, i = wp.int32(0), wp.int32(0)
        s = first
        while s <= last and transmitted >= end:
            x = o + s * d
            alpha = opacity(density_at(place, density, x), interval, shift)
            if transmitted * alpha > least:
                if fill == 1:
                    points[starts[r] + count] = x
                    rays[starts[r] + count] = wp.int64(r)
                count += 1
                transmitted *= real(1.0) - alpha
            i += 1
            s = first + real(i) * step
        if fill == 0:
            counts[r] = count

    @kernel
    def composite(background, starts, alphas, colours, reaching, pictures, passed):
        """C = sum_i T_i alpha_i c_i + T background with T_i = prod_{j < i} (1 - alpha_j), stored in `reaching`."""
        r = wp.tid()
        transmitted = real(1.0)
        light = vec3()
        for i in range(starts[r], starts[r + 1]):
            reaching[i] = transmitted
            light += (transmitted * alphas[i]) * colours[i]
            transmitted *= real(1.0) - alphas[i]
        pictures[r] = light + transmitted * background
        passed[r] = transmitted

    @kernel
    def composite_adjoint(
        background, starts, alphas, colours, reaching, grad_pictures, grad_passed, grad_alphas, grad_colours
    ):
        """Back to front, with the colour B and the transmittance P behind point i, which avoids division by 1 - alpha.

        dC/dalpha_i = T_i (c_i - B),  dT/dalpha_i = -T_i P,  dC/dc_i = T_i alpha_i.
        """
        r = wp.tid()
        g, g_passed = grad_pictures[r], grad_passed[r]
        behind, passing = background, real(1.0)
        count = starts[r + 1] - starts[r]
        for k in range(count):
            i = starts[r + 1] - 1 - k
            a, c = alphas[i], colours[i]
            grad_alphas[i] = reaching[i] * (wp.dot(g, c - behind) - g_passed * passing)
            grad_colours[i] = (reaching[i] * a) * g
            behind = a * c + (real(1.0) - a) * behind
            passing *= real(1.0) - a

    return SimpleNamespace(march=march, composite=composite, composite_adjoint=composite_adjoint)
