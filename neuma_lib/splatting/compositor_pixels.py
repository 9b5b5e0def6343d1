"""Pixel-major compositing: one thread a pixel walks all splats of its image in depth order.

Simple and slow: the way to float64 images on CUDA, where ``splat_tiles`` works in float32. It gives the same images
and gradients as ``splat_rows`` to rounding. Gradients of a splat are summed with atomics, so their last bits vary
between runs.
"""

import functools

import torch
import warp as wp

from neuma_lib.device import start_warp
from neuma_lib.splatting.arrays import plain, target
from neuma_lib.splatting.compositing import Settings, depth_order

start_warp()


def composite(splats, depths, background, settings: Settings, empty):
    """See ``compositing``."""
    shape = (*depths.shape[:1], settings.height, settings.width)
    pictures, alphas = empty("pictures", (*shape, 3), splats), empty("alphas", shape, splats)
    kept = (
        *depth_order(depths),
        empty("transmittances", shape, splats),
        empty("stops", shape, splats, torch.int32),
    )
    order, seen, transmittances, stops = map(plain, kept)
    kernel, _ = kernels(splats.dtype)
    wp.launch(
        kernel,
        dim=shape,
        inputs=[
            plain(splats), order, seen, settings.alpha_min, settings.alpha_max, settings.transmittance_min,
            plain(background),
        ],
        outputs=[plain(pictures), plain(alphas), transmittances, stops],
        **target(splats),
    )  # fmt: skip
    return pictures, alphas, kept


def composite_adjoint(
    splats, kept, background, settings: Settings, grad_pictures, grad_alphas, grad_splats, empty
):
    """See ``compositing``."""
    order, _, transmittances, stops = map(plain, kept)
    grad_splats.zero_()
    _, kernel = kernels(splats.dtype)
    wp.launch(
        kernel,
        dim=grad_alphas.shape,
        inputs=[
            plain(splats), order, settings.alpha_min, settings.alpha_max, plain(background), transmittances, stops,
            plain(grad_pictures), plain(grad_alphas),
        ],
        outputs=[plain(grad_splats)],
        **target(splats),
    )  # fmt: skip


@functools.cache
def kernels(dtype: torch.dtype):
    """``(composite, composite_adjoint)`` Warp kernels of a dtype, launched over (images, H, W)."""
    real = wp.dtype_from_torch(dtype)
    vec3 = wp.types.vector(3, real)
    module = wp.get_module(f"{__name__}.{str(dtype).removeprefix('torch.')}")
    zero, half, one = real(0), real(0.5), real(1)

    @wp.func(module=module)
    def exponent(splats: wp.array3d(dtype=real), image: int, g: wp.int64, x: real, y: real):
        dx = x - splats[image, g, 0]
        dy = y - splats[image, g, 1]
        return (
            half * (splats[image, g, 2] * dx * dx + splats[image, g, 4] * dy * dy)
            + splats[image, g, 3] * dx * dy
        )

    @wp.kernel(module=module, enable_backward=False)
    def composite(
        splats: wp.array3d(dtype=real),  # (I, G, SPLAT_SIZE)
        order: wp.array2d(dtype=wp.int64),  # (I, G) indices by depth
        seen: wp.array(dtype=wp.int64),  # (I,) how many of them are not culled
        alpha_min: real,
        alpha_max: real,
        transmittance_min: real,
        background: wp.array(dtype=real),  # (3,)
        pictures: wp.array4d(dtype=real),  # (I, H, W, 3), out
        alphas: wp.array3d(dtype=real),  # (I, H, W), out
        transmittances: wp.array3d(dtype=real),  # (I, H, W), out
        stops: wp.array3d(dtype=int),  # (I, H, W) rank of the first splat not drawn, out
    ):
        image, row, column = wp.tid()
        x = real(column) + half
        y = real(row) + half
        transmittance = one
        colour = vec3()
        stop = int(seen[image])
        rank = wp.int32(0)
        while rank < stop:
            g = order[image, rank]
            sigma = exponent(splats, image, g, x, y)
            alpha = wp.min(alpha_max, splats[image, g, 5] * wp.exp(-sigma))
            if sigma >= zero and alpha >= alpha_min:
                after = transmittance * (one - alpha)
                if after < transmittance_min:
                    stop = rank
                else:
                    weight = alpha * transmittance
                    colour += weight * vec3(splats[image, g, 6], splats[image, g, 7], splats[image, g, 8])
                    transmittance = after
            rank += 1
        for i in range(3):
            pictures[image, row, column, i] = colour[i] + transmittance * background[i]
        alphas[image, row, column] = one - transmittance
        transmittances[image, row, column] = transmittance
        stops[image, row, column] = stop

    @wp.kernel(module=module, enable_backward=False)
    def composite_adjoint(
        splats: wp.array3d(dtype=real),  # (I, G, SPLAT_SIZE)
        order: wp.array2d(dtype=wp.int64),  # (I, G)
        alpha_min: real,
        alpha_max: real,
        background: wp.array(dtype=real),  # (3,)
        transmittances: wp.array3d(dtype=real),  # (I, H, W)
        stops: wp.array3d(dtype=int),  # (I, H, W)
        grad_pictures: wp.array4d(dtype=real),  # (I, H, W, 3)
        grad_alphas: wp.array3d(dtype=real),  # (I, H, W)
        grad_splats: wp.array3d(dtype=real),  # (I, G, SPLAT_SIZE), added to
    ):
        image, row, column = wp.tid()
        x = real(column) + half
        y = real(row) + half
        transmittance = transmittances[image, row, column]
        grad = vec3(
            grad_pictures[image, row, column, 0],
            grad_pictures[image, row, column, 1],
            grad_pictures[image, row, column, 2],
        )
        # gradient-weighted light that reaches this pixel from behind the current splat
        behind = transmittance * (
            grad[0] * background[0]
            + grad[1] * background[1]
            + grad[2] * background[2]
            - grad_alphas[image, row, column]
        )
        rank = stops[image, row, column] - 1
        while rank >= 0:
            g = order[image, rank]
            sigma = exponent(splats, image, g, x, y)
            raw = splats[image, g, 5] * wp.exp(-sigma)
            alpha = wp.min(alpha_max, raw)
            if sigma >= zero and alpha >= alpha_min:
                inverse = one / (one - alpha)
                transmittance = transmittance * inverse
                weight = alpha * transmittance
                shade = wp.dot(grad, vec3(splats[image, g, 6], splats[image, g, 7], splats[image, g, 8]))
                for i in range(3):
                    wp.atomic_add(grad_splats, image, int(g), 6 + i, weight * grad[i])
                if raw <= alpha_max:
                    slope = alpha * (transmittance * shade - behind * inverse)
                    dx = x - splats[image, g, 0]
                    dy = y - splats[image, g, 1]
                    a = splats[image, g, 2]
                    b = splats[image, g, 3]
                    c = splats[image, g, 4]
                    wp.atomic_add(grad_splats, image, int(g), 0, slope * (a * dx + b * dy))
                    wp.atomic_add(grad_splats, image, int(g), 1, slope * (b * dx + c * dy))
                    wp.atomic_add(grad_splats, image, int(g), 2, -half * slope * dx * dx)
                    wp.atomic_add(grad_splats, image, int(g), 3, -slope * dx * dy)
                    wp.atomic_add(grad_splats, image, int(g), 4, -half * slope * dy * dy)
                    wp.atomic_add(grad_splats, image, int(g), 5, slope / splats[image, g, 5])
                behind += weight * shade
            rank -= 1

    return composite, composite_adjoint
