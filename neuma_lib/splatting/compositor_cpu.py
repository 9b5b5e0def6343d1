"""Splat-major compositing on a CPU: splats in depth order, each over the tiles that its ellipse reaches.

A tile of 4x4 pixels is one vector of Clang, which Warp embeds on every platform, so these kernels are native snippets.
On one core, a loop over splats and their tiles needs no lists, and parameters and sums of a splat stay in registers.
Tiles store transmittance, colours and the rank at which each pixel became opaque; splats skip tiles without open
pixels. The reverse pass visits the splats backwards and recovers the previous transmittance by dividing by 1 - alpha.
Images are processed one after the other and share memory for sorting and for the reverse pass, which stays in the
cache.
"""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from neuma_lib.device import launch, native_source, start_warp, typed
from neuma_lib.splatting.compositing import Settings
from neuma_lib.splatting.projection import CULLED
from neuma_lib.splatting.records import SPLAT_SIZE

start_warp()

TILE = 4
LISTED = 4200
"""More than the tiles that are listed before the last splat of a list. Keeps the list in the fastest cache."""
PLANES = 5
"""Numbers per pixel: see ``compositor_cpu.cpp``; in the reverse pass transmittance, gradients of red, green and blue,
and gradient-weighted light from behind."""


def composite(splats, depths, background, settings: Settings, empty):
    """See ``compositing``."""
    shape = (len(depths), settings.height, settings.width)
    pictures, alphas = empty("pictures", (*shape, 3), splats), empty("alphas", shape, splats)
    kept = _kept(splats, settings, empty)
    launch(
        kernels(splats.dtype).draw, len(depths), splats, depths, *_thresholds(settings), settings.transmittance_min,
        background, *_spare(kept), *kept, pictures, alphas,
    )  # fmt: skip
    return pictures, alphas, kept


def composite_adjoint(
    splats, kept, background, settings: Settings, grad_pictures, grad_alphas, grad_splats, empty
):
    """See ``compositing``."""
    launch(
        kernels(splats.dtype).draw_adjoint, len(splats), splats, *_thresholds(settings), background, *kept,
        grad_pictures, grad_alphas, *_spare(kept), torch.empty_like(kept[-1][0]), grad_splats,
    )  # fmt: skip


def compare(splats, depths, background, settings: Settings, observed, empty):
    """See ``compositing``."""
    kept = _kept(splats, settings, empty)
    sums = empty("sums", (len(depths),), splats, torch.float64)
    launch(
        kernels(splats.dtype).compare, len(depths), splats, depths, *_thresholds(settings), settings.transmittance_min,
        background, *_spare(kept), *kept, observed, sums,
    )  # fmt: skip
    return sums[:, None], kept


def compare_adjoint(splats, kept, background, settings: Settings, scales, opacities: bool, grad_splats):
    """See ``compositing``."""
    launch(
        kernels(splats.dtype).compare_adjoint, len(splats), splats, *_thresholds(settings), background, *kept,
        settings.width, settings.height, scales, opacities, *_spare(kept), torch.empty_like(kept[-1][0]), grad_splats,
    )  # fmt: skip


def _kept(splats, settings: Settings, empty) -> tuple[torch.Tensor, ...]:
    """Memory for the splats by rank (I, G), their numbers (I,), and the first hidden rank and planes of each tile."""
    tiles = -(-settings.width // TILE) * -(-settings.height // TILE)
    order, numbers, ends = (
        empty(name, (len(splats), *size), splats, torch.int32)
        for name, size in (("order", splats.shape[1:2]), ("numbers", ()), ("ends", (tiles,)))
    )
    return order, numbers, ends, empty("planes", (len(splats), tiles, PLANES, TILE**2), splats)


def _spare(kept) -> tuple[torch.Tensor, torch.Tensor]:
    """Memory to sort the splats of one image and to list their tiles, and for the corners of these."""
    order, _, ends, planes = kept
    listed = LISTED + ends.shape[1]
    return order.new_empty(max(order.shape[1], listed)), planes.new_empty(2, listed)


def _thresholds(settings: Settings) -> tuple[float, float]:
    return settings.alpha_min, settings.alpha_max


def source(dtype: torch.dtype, *names: str, **parts: str) -> str:
    """C++ text of a function from parts of ``compositor_cpu.cpp``, in which names of other parts are replaced."""
    texts = native_source(__file__, ".cpp")
    text = "".join(texts[name] for name in ("types", "exp2_" + str(dtype).removeprefix("torch."), *names))
    for name, part in parts.items():
        text = text.replace(f"{name}\n", texts[part] + "\n" if part else "\n")
    real = {torch.float32: "float", torch.float64: "double"}[dtype]
    for constant, value in {"SPLAT_SIZE": SPLAT_SIZE, "CULLED": CULLED, "REAL": real}.items():
        text = text.replace(constant, str(value))
    return text


@functools.cache
def kernels(dtype: torch.dtype):
    """Kernels ``draw``, ``draw_adjoint``, ``compare``, ``compare_adjoint`` of a dtype, CPU only. A thread processes an
    image; Warp runs them one after the other."""
    real = wp.dtype_from_torch(dtype)
    types = {
        "background": wp.array(dtype=real),  # (3,)
        "splats": wp.array3d(dtype=real),  # (I, G, SPLAT_SIZE)
        "depths": wp.array2d(dtype=real),  # (I, G)
        "spare": wp.array(dtype=int),
        "corners": wp.array2d(dtype=real),
        "order": wp.array2d(dtype=int),  # (I, G), out: the splats that are not culled by depth
        "numbers": wp.array(dtype=int),  # (I,), out: their number
        "ends": wp.array2d(dtype=int),  # (I, tiles), out
        "planes": wp.array4d(
            dtype=real
        ),  # (I, tiles, PLANES, TILE^2), out; differences of colours in `compare`
        "pictures": wp.array4d(dtype=real),  # (I, H, W, 3), out
        "alphas": wp.array3d(dtype=real),  # (I, H, W), out
        "observed": wp.array3d(dtype=int),  # (I, H, W)
        "sums": wp.array(dtype=wp.float64),  # (I,), out
        "scales": wp.array(dtype=real),  # (I,)
        "scratch": wp.array3d(dtype=real),  # (tiles, PLANES, TILE^2)
        "grad_splats": wp.array3d(dtype=real),  # (I, G, SPLAT_SIZE), out
        "grad_pictures": wp.array4d(dtype=real),  # (I, H, W, 3)
        "grad_alphas": wp.array3d(dtype=real),  # (I, H, W)
        "opacities": bool,
        **dict.fromkeys(("image", "count", "height", "width"), int),
        **dict.fromkeys(("alpha_min", "alpha_max", "transmittance_min", "back0", "back1", "back2"), real),
    }
    own = typed(types)
    kernel = own.kernel(wp.get_module(f"{__name__}.{str(dtype).removeprefix('torch.')}"))
    forward = dict(SPLATS_LOOP="splats", START="", BODY="forward_body", FINISH="")
    backward = dict(SPLATS_LOOP="splats", START="sums", BODY="backward_body", FINISH="gradients")

    @own.func_native(source(dtype, "rank", "forward", "draw", **forward))
    def draw_image(
        image, count, height, width, splats, depths, alpha_min, alpha_max, transmittance_min, back0, back1, back2,
        spare, corners, order, numbers, ends, planes, pictures, alphas,
    ): ...  # fmt: skip

    @own.func_native(source(dtype, "rank", "forward", "compare", **forward))
    def compare_image(
        image, count, height, width, splats, depths, alpha_min, alpha_max, transmittance_min, back0, back1, back2,
        spare, corners, order, numbers, ends, planes, observed, sums,
    ): ...  # fmt: skip

    @own.func_native(source(dtype, "backward", GRADIENTS="image_gradients", **backward))
    def draw_image_adjoint(
        image, count, height, width, splats, alpha_min, alpha_max, back0, back1, back2, order, numbers, ends, planes,
        opacities, spare, corners, scratch, grad_splats, grad_pictures, grad_alphas,
    ): ...  # fmt: skip

    @own.func_native(source(dtype, "backward", GRADIENTS="error_gradients", **backward))
    def compare_image_adjoint(
        image, count, height, width, splats, alpha_min, alpha_max, back0, back1, back2, order, numbers, ends, planes,
        opacities, spare, corners, scratch, grad_splats, scales,
    ): ...  # fmt: skip

    @kernel
    def draw(
        splats, depths, alpha_min, alpha_max, transmittance_min, background, spare, corners, order, numbers, ends,
        planes, pictures, alphas,
    ):  # fmt: skip
        draw_image(
            wp.tid(), splats.shape[1], alphas.shape[1], alphas.shape[2], splats, depths, alpha_min, alpha_max,
            transmittance_min, background[0], background[1], background[2], spare, corners, order, numbers, ends,
            planes, pictures, alphas,
        )  # fmt: skip

    @kernel
    def compare(
        splats, depths, alpha_min, alpha_max, transmittance_min, background, spare, corners, order, numbers, ends,
        planes, observed, sums,
    ):  # fmt: skip
        compare_image(
            wp.tid(), splats.shape[1], observed.shape[1], observed.shape[2], splats, depths, alpha_min, alpha_max,
            transmittance_min, background[0], background[1], background[2], spare, corners, order, numbers, ends,
            planes, observed, sums,
        )  # fmt: skip

    @kernel
    def draw_adjoint(
        splats, alpha_min, alpha_max, background, order, numbers, ends, planes, grad_pictures, grad_alphas, spare,
        corners, scratch, grad_splats,
    ):  # fmt: skip
        draw_image_adjoint(
            wp.tid(), splats.shape[1], grad_alphas.shape[1], grad_alphas.shape[2], splats, alpha_min, alpha_max,
            background[0], background[1], background[2], order, numbers, ends, planes, True, spare, corners,
            scratch, grad_splats, grad_pictures, grad_alphas,
        )  # fmt: skip

    @kernel
    def compare_adjoint(
        splats, alpha_min, alpha_max, background, order, numbers, ends, planes, width, height, scales, opacities,
        spare, corners, scratch, grad_splats,
    ):  # fmt: skip
        compare_image_adjoint(
            wp.tid(), splats.shape[1], height, width, splats, alpha_min, alpha_max, background[0], background[1],
            background[2], order, numbers, ends, planes, opacities, spare, corners, scratch, grad_splats, scales,
        )  # fmt: skip

    return SimpleNamespace(
        draw=draw, draw_adjoint=draw_adjoint, compare=compare, compare_adjoint=compare_adjoint
    )
