"""Splat-major compositing on a CPU: splats in depth order, each over the exact rows and columns that it covers.

On one core, a loop over splats and their pixels is faster than the pixel-major order of a GPU, because it needs no tile
lists and all loads are contiguous. Pixels store colour, transmittance T and the rank at which they became opaque. The
reverse pass visits the splats backwards and recovers the previous transmittance by dividing by 1 - alpha.

Rows are processed eight pixels at a time with the vector types of Clang, which Warp embeds on every platform, so these
kernels are native snippets. Planes have padded rows (``padded_width``). Values of lanes right of the image are unused,
and their image gradient is zero.
"""

import functools

import torch
import warp as wp

from neuma_lib.device import launch, native_source, start_warp
from neuma_lib.splatting.compositing import Settings, depth_order
from neuma_lib.splatting.records import SPLAT_SIZE

start_warp()

LANES = 8
FORWARD_PLANES = 5  # transmittance, red, green, blue, rank of the first splat that was not drawn
BACKWARD_PLANES = 5  # transmittance, gradients of red, green, blue, gradient-weighted light from behind


def composite(splats, depths, background, settings: Settings, empty):
    """See ``compositing``."""
    shape = (*depths.shape[:1], settings.height, settings.width)
    pictures, alphas = empty("pictures", (*shape, 3), splats), empty("alphas", shape, splats)
    planes = (shape[0], FORWARD_PLANES, settings.height, padded_width(settings.width))
    kept = (*depth_order(depths), empty("planes", planes, splats))
    order, seen, planes = kept
    kernel, _ = kernels(splats.dtype)
    launch(
        kernel, shape[0], splats, order, seen, settings.alpha_min, settings.alpha_max, settings.transmittance_min,
        background, planes, pictures, alphas,
    )  # fmt: skip
    return pictures, alphas, kept


def composite_adjoint(
    splats, kept, background, settings: Settings, grad_pictures, grad_alphas, grad_splats, empty
):
    """See ``compositing``."""
    order, seen, planes = kept
    scratch = empty("scratch", (len(planes), BACKWARD_PLANES, *planes.shape[2:]), splats)
    _, kernel = kernels(splats.dtype)
    launch(
        kernel, len(planes), splats, order, seen, settings.alpha_min, settings.alpha_max, background, planes,
        grad_pictures, grad_alphas, scratch, grad_splats,
    )  # fmt: skip


def padded_width(width: int) -> int:
    """Row length of the planes, such that a splat that starts at the last column fills all lanes."""
    return width + LANES


def source(name: str, dtype: torch.dtype) -> str:
    """C++ text of a pass, "forward" or "backward"."""
    parts = native_source(__file__, ".cpp")
    exponential = parts["exp_" + str(dtype).removeprefix("torch.")]
    loops = parts["splat"].replace("BODY\n", parts[f"{name}_body"] + "\n")
    text = parts["types"] + exponential + parts[name].replace("SPLAT\n", loops + "\n")
    real = {torch.float32: "float", torch.float64: "double"}[dtype]
    for constant, value in {"SPLAT_SIZE": SPLAT_SIZE, "LANES": LANES, "REAL": real}.items():
        text = text.replace(constant, str(value))
    return text


@functools.cache
def kernels(dtype: torch.dtype):
    """``(composite, composite_adjoint)`` Warp kernels of a dtype; one thread per image, CPU only."""
    real = wp.dtype_from_torch(dtype)
    module = wp.get_module(f"{__name__}.{str(dtype).removeprefix('torch.')}")

    @wp.func_native(source("forward", dtype))
    def composite_image(
        image: int, count: int, seen: int, height: int, width: int, pitch: int,
        splats: wp.array3d(dtype=real), order: wp.array2d(dtype=wp.int64),
        alpha_min: real, alpha_max: real, transmittance_min: real,
        back0: real, back1: real, back2: real,
        planes: wp.array4d(dtype=real), pictures: wp.array4d(dtype=real), alphas: wp.array3d(dtype=real),
    ): ...  # fmt: skip

    @wp.func_native(source("backward", dtype))
    def composite_image_adjoint(
        image: int, count: int, seen: int, height: int, width: int, pitch: int,
        splats: wp.array3d(dtype=real), order: wp.array2d(dtype=wp.int64),
        alpha_min: real, alpha_max: real,
        back0: real, back1: real, back2: real,
        planes: wp.array4d(dtype=real),
        grad_pictures: wp.array4d(dtype=real), grad_alphas: wp.array3d(dtype=real),
        scratch: wp.array4d(dtype=real), grad_splats: wp.array3d(dtype=real),
    ): ...  # fmt: skip

    @wp.kernel(module=module, enable_backward=False)
    def composite(
        splats: wp.array3d(dtype=real),  # (I, G, SPLAT_SIZE)
        order: wp.array2d(dtype=wp.int64),  # (I, G) indices by depth
        seen: wp.array(dtype=wp.int64),  # (I,) number of splats that are not culled
        alpha_min: real,
        alpha_max: real,
        transmittance_min: real,
        background: wp.array(dtype=real),  # (3,)
        planes: wp.array4d(dtype=real),  # (I, FORWARD_PLANES, H, padded W), out
        pictures: wp.array4d(dtype=real),  # (I, H, W, 3), out
        alphas: wp.array3d(dtype=real),  # (I, H, W), out
    ):
        i = wp.tid()
        composite_image(
            i, splats.shape[1], int(seen[i]), alphas.shape[1], alphas.shape[2], planes.shape[3],
            splats, order, alpha_min, alpha_max, transmittance_min,
            background[0], background[1], background[2], planes, pictures, alphas,
        )  # fmt: skip

    @wp.kernel(module=module, enable_backward=False)
    def composite_adjoint(
        splats: wp.array3d(dtype=real),  # (I, G, SPLAT_SIZE)
        order: wp.array2d(dtype=wp.int64),  # (I, G)
        seen: wp.array(dtype=wp.int64),  # (I,)
        alpha_min: real,
        alpha_max: real,
        background: wp.array(dtype=real),  # (3,)
        planes: wp.array4d(dtype=real),  # (I, FORWARD_PLANES, H, padded W)
        grad_pictures: wp.array4d(dtype=real),  # (I, H, W, 3)
        grad_alphas: wp.array3d(dtype=real),  # (I, H, W)
        scratch: wp.array4d(dtype=real),  # (I, BACKWARD_PLANES, H, padded W)
        grad_splats: wp.array3d(dtype=real),  # (I, G, SPLAT_SIZE), out
    ):
        i = wp.tid()
        composite_image_adjoint(
            i, splats.shape[1], int(seen[i]), grad_alphas.shape[1], grad_alphas.shape[2],
            planes.shape[3], splats, order, alpha_min, alpha_max, background[0], background[1], background[2],
            planes, grad_pictures, grad_alphas, scratch, grad_splats,
        )  # fmt: skip

    return composite, composite_adjoint
