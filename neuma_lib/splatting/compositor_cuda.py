"""Compositing for CUDA in float32: tiles of every image, with a list of splats in depth order for every tile.

Lists. A splat is listed in a tile if the ellipse with alpha >= alpha_min reaches one of the tile's pixel centres (plus
a small tolerance). In every row of tiles an ellipse covers one interval of columns, which has a closed form, so the
lists are tighter than with bounding boxes. All splats of all images are sorted by depth once, written to the lists in
that order, and sorted stably by tile, with as many bits as tiles need. The host reads the number of entries once per
call.

Compositing. A warp owns a patch of 8 x (4 LANE_PIXELS) pixels, ``LANE_PIXELS`` per lane, and processes the list of its
tile independently of other warps, 32 entries at a time. Each lane loads one splat and tests it exactly against the
patch (minimum of the quadratic form over the rectangle of pixel centres). The warp then composites the entries that
passed. This combines the short lists of large tiles with the few rejected splats per pixel of small tiles. A warp ends
when its pixels are opaque.

Adjoint. The same list backwards. Nine sums per splat and patch are taken over the pixels of a lane and then over lanes
by recursive halving: in each of five exchanges between lanes, both sides keep half of the sums. This takes 12 exchanges
instead of 45, and ends with nine lanes that add the sums to memory by one instruction. (The alternative, one splat per
lane with pixels passed between lanes, stores the state of the pixels for every 32 splats and needs as much arithmetic
at this patch size.) Atomic additions occur in any order, so the last bits vary between runs.

Comparison. If only a squared error is needed, the first pass subtracts the observed pixel from the colour in registers,
sums the squares of a patch in a fixed order and stores the difference, from which the adjoint computes the pixel's
gradient. No image is written or read, and tiles without splats only read the observation. For fixed opacities the
adjoint omits their sum and needs 9 exchanges for eight sums.

Peak memory of a call in bytes: 24 per pixel (images, alphas, data for the adjoint), 16 more per pixel for incoming
gradients, 130 per splat and image, 16 per list entry, of which 8 remain for the adjoint. A splat with a deviation of
3 px has 4 to 5 entries, so 40 images of 800 x 800 with 20,000 splats each take 1.2 GB. A comparison takes 20 per pixel
in total, and accesses only those of tiles with splats.
"""

import functools
import re

import torch
import warp as wp

from neuma_lib.device import launch, native_source, sort_pairs, start_warp, typed
from neuma_lib.errors import InputError
from neuma_lib.splatting.compositing import Settings
from neuma_lib.splatting.projection import CULLED
from neuma_lib.splatting.records import SPLAT_SIZE, functions

start_warp()

TILE = 16  # side of a tile [px], a multiple of the sides of a patch
LANE_PIXELS = 2  # vertically adjacent pixels per lane; a patch has 8 columns and 4 LANE_PIXELS rows
PATCH_WIDTH = 8
SLACK = 0.01  # tolerance of intervals of pixels for round-off [px]


def composite(splats, depths, background, settings: Settings, empty):
    """See ``compositing``."""
    shape = (*depths.shape[:1], settings.height, settings.width)
    pictures, alphas = empty("pictures", (*shape, 3), splats), empty("alphas", shape, splats)
    ids, starts = lists(splats, depths, settings.width, settings.height, TILE)
    kept = (ids, starts, empty("transmittances", shape, splats), empty("stops", shape, splats, torch.int32))
    kernel, _, threads = kernels(TILE, LANE_PIXELS)
    launch(
        kernel, (len(starts) - 1) * threads, splats, ids, starts, settings.alpha_min, settings.alpha_max,
        settings.transmittance_min, background, pictures, alphas, *kept[2:], block_dim=threads,
    )  # fmt: skip
    return pictures, alphas, kept


def composite_adjoint(
    splats, kept, background, settings: Settings, grad_pictures, grad_alphas, grad_splats, empty
):
    """See ``compositing``."""
    _, starts, *_ = kept
    grad_splats.zero_()
    _, kernel, threads = kernels(TILE, LANE_PIXELS)
    launch(
        kernel, (len(starts) - 1) * threads, splats, *kept, settings.alpha_min, settings.alpha_max, background,
        grad_pictures, grad_alphas, grad_splats, block_dim=threads,
    )  # fmt: skip
    _, finish = list_kernels()
    launch(finish, splats.shape[:2], splats, grad_splats)


def compare(splats, depths, background, settings: Settings, observed, empty):
    """See ``compositing``."""
    ids, starts = lists(splats, depths, settings.width, settings.height, TILE)
    tiles = len(starts) - 1
    kernel, threads = comparing_kernel(TILE, LANE_PIXELS)
    sums = empty("sums", (tiles, threads // 32), splats, torch.float64)
    states = empty("states", (tiles, TILE**2, 4), splats)
    kept = (ids, starts, states, empty("stops", (tiles, TILE**2), splats, torch.int32))
    launch(
        kernel, tiles * threads, splats, ids, starts, settings.alpha_min, settings.alpha_max,
        settings.transmittance_min, background, observed, sums, *kept[2:], block_dim=threads,
    )  # fmt: skip
    return sums.view(len(observed), -1), kept


def compare_adjoint(splats, kept, background, settings: Settings, scales, opacities: bool, grad_splats):
    """See ``compositing``."""
    _, starts, *_ = kept
    grad_splats.zero_()
    kernel, threads = comparing_adjoint(TILE, LANE_PIXELS, opacities)
    launch(
        kernel, (len(starts) - 1) * threads, splats, *kept, settings.alpha_min, settings.alpha_max, background,
        settings.width, settings.height, scales, grad_splats, block_dim=threads,
    )  # fmt: skip
    _, finish = list_kernels()
    launch(finish, splats.shape[:2], splats, grad_splats)


def lists(
    splats: torch.Tensor, depths: torch.Tensor, width: int, height: int, tile: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Splats of every tile from near to far. Runs on CPU and CUDA; synchronises once with the GPU.

    Args:
        splats: (I, G, SPLAT_SIZE) and depths (I, G) of ``projection``, float32.
        width, height: of the images [px].
        tile: side of a tile [px].

    Returns:
        ids (N,) int32: splat g of image i is i G + g; starts (tiles + 1,) int32: entries ``starts[t]`` to
        ``starts[t + 1]`` belong to tile t, tiles counted along rows, then images.

    Raises:
        InputError: more pixels, splats or entries than the range of int32.
    """
    images, count = depths.shape
    tiles = images * -(-width // tile) * -(-height // tile)
    visit_tiles, _ = list_kernels()
    order = by_depth(depths)
    sizes = torch.empty_like(order)
    geometry = (order, splats, depths, width, height, tile)
    launch(visit_tiles, len(order), *geometry, sizes, None, None, None)
    ends = torch.cumsum(sizes, dim=0, dtype=torch.int64)
    total = int(ends[-1]) if len(ends) else 0
    if max(total, len(order), tiles * tile**2) >= 2**31:
        raise InputError(
            "rasterize",
            f"{images} images of {width} x {height} px with {count} Gaussians ({total} entries in tiles) exceed 2^31",
            "Render fewer frames per call",
        )
    if total == 0:
        return sizes.new_empty(0), sizes.new_zeros(tiles + 1)
    keys, ids = sizes.new_empty(2 * total), sizes.new_empty(2 * total)
    launch(visit_tiles, len(order), *geometry, sizes, ends, keys, ids)
    sort_pairs(keys, ids, total, bits=(tiles - 1).bit_length())
    limits = torch.arange(tiles + 1, dtype=torch.int32, device=keys.device)
    return ids[:total], torch.searchsorted(keys[:total], limits, out_int32=True)


def by_depth(depths: torch.Tensor) -> torch.Tensor:
    """Splats of all images (I G,) int32 from near to far, by their depths (I, G), float32 and not negative."""
    count = depths.numel()
    keys = depths.new_empty(2 * count)
    keys[:count] = depths.view(-1)
    order = torch.arange(2 * count, dtype=torch.int32, device=depths.device)
    sort_pairs(keys, order, count)
    return order[:count]


@functools.cache
def list_kernels():
    """``(visit_tiles, finish)`` Warp kernels. ``visit_tiles`` counts the tiles of splats, or lists them where they are
    counted, and ``finish`` converts sums to gradients."""
    module = wp.get_module(f"{__name__}.lists")
    # Counting and listing must agree to the last bit, so fused multiply-add is disabled.
    wp.set_module_options({"fuse_fp": False}, module)
    culled = wp.float32(CULLED)
    slack = wp.float32(SLACK)
    load, store = functions(torch.float32)

    @wp.func(module=module)
    def pixels(low: float, high: float, extent: int):
        # first and last pixel with a centre between low and high; first > last if there is none
        last = float(extent)
        first_pixel = int(wp.ceil(wp.clamp(low - 0.5 - slack, -1.0, last)))
        last_pixel = int(wp.floor(wp.clamp(high - 0.5 + slack, -1.0, last)))
        # the integers are clamped again in case low or high is NaN
        return wp.clamp(first_pixel, 0, extent), wp.clamp(last_pixel, -1, extent - 1)

    @wp.func(module=module)
    def half_width(dy: float, reach: float, A: float, half_height: float):
        part = dy / half_height
        return wp.sqrt(reach / A) * wp.sqrt(wp.max(1.0 - part * part, 0.0))

    @wp.func(module=module)
    def columns(place: wp.vec4, C: float, ellipse: wp.vec4, low: float, high: float, width: int):
        # first and last pixel column of the ellipse between the heights low and high, relative to its centre
        mean, A, B = place[0], place[2], place[3]
        reach, half_height = ellipse[1], ellipse[3]
        bottom = wp.clamp(low, -half_height, half_height)
        top = wp.clamp(high, -half_height, half_height)
        tilt = B / C * ellipse[2]  # height of the leftmost point; minus that of the rightmost
        left = wp.clamp(tilt, bottom, top)
        right = wp.clamp(-tilt, bottom, top)
        slope = -B / A
        first, last = pixels(
            mean + slope * left - half_width(left, reach, A, half_height),
            mean + slope * right + half_width(right, reach, A, half_height),
            width,
        )
        return first, last

    @wp.kernel(module=module, enable_backward=False)
    def visit_tiles(
        order: wp.array(dtype=int),  # (I G,) by depth
        splats: wp.array3d(dtype=float),  # (I, G, SPLAT_SIZE)
        depths: wp.array2d(dtype=float),  # (I, G)
        width: int,
        height: int,
        tile: int,
        sizes: wp.array(dtype=int),  # (I G,) number of tiles, out if there are no `ends`
        ends: wp.array(dtype=wp.int64),  # (I G,) sums of sizes, or None
        keys: wp.array(dtype=int),  # (N,) tile of every entry, out, or None
        ids: wp.array(dtype=int),  # (N,) splat of every entry, out, or None
    ):
        rank = wp.tid()
        splat = order[rank]
        image = splat // splats.shape[1]
        g = splat - image * splats.shape[1]
        tiles_x = (width + tile - 1) // tile
        tiles_y = (height + tile - 1) // tile
        size = int(0)  # noqa: UP018, Warp cannot modify a constant in a loop
        if depths[image, g] < culled:
            place, ellipse = load(splats, image, g, 0), load(splats, image, g, 2)
            C = splats[image, g, 4]
            centre, half_height = place[1], ellipse[3]
            top, bottom = pixels(centre - half_height, centre + half_height, height)
            if top <= bottom:
                for row in range(top // tile, bottom // tile + 1):
                    low = float(wp.max(row * tile, top)) + 0.5 - centre
                    high = float(wp.min(row * tile + tile - 1, bottom)) + 0.5 - centre
                    first, last = columns(place, C, ellipse, low, high, width)
                    if first <= last:
                        if ends:
                            position = int(ends[rank]) - sizes[rank] + size - first // tile
                            for column in range(first // tile, last // tile + 1):
                                keys[position + column] = (image * tiles_y + row) * tiles_x + column
                                ids[position + column] = splat
                        size += last // tile - first // tile + 1
        if not ends:
            sizes[rank] = size

    @wp.kernel(module=module, enable_backward=False)
    def finish(
        splats: wp.array3d(dtype=float),  # (I, G, SPLAT_SIZE)
        grad_splats: wp.array3d(dtype=float),  # (I, G, SPLAT_SIZE), in: sums of the adjoint, out: gradients
    ):
        image, g = wp.tid()
        near, far = load(grad_splats, image, g, 0), load(grad_splats, image, g, 1)
        s, s_x, s_y, s_xx, s_xy, s_yy = near[0], near[1], near[2], near[3], far[0], far[1]
        place, shade = load(splats, image, g, 0), load(splats, image, g, 1)
        A, B, C = place[2], place[3], shade[0]
        store(grad_splats, image, g, 0, A * s_x + B * s_y, B * s_x + C * s_y, -0.5 * s_xx, -s_xy)
        store(grad_splats, image, g, 1, -0.5 * s_yy, s / shade[1], far[2], far[3])

    return visit_tiles, finish


def source(name: str, tile: int, lane_pixels: int, compares: bool = False, opacities: bool = True) -> str:
    """CUDA code of a pass, "forward" or "backward", with its constants, for images or for their comparison.

    ``opacities``: compute the sum for gradients of opacities.
    """
    parts = native_source(__file__)
    text = parts["common"] + parts[name]
    height = 4 * lane_pixels
    values = {
        "TILE": tile,
        "LANE_PIXELS": lane_pixels,
        "PATCH_WIDTH": PATCH_WIDTH,
        "PATCH_HEIGHT": height,
        "WARPS": tile * tile // (PATCH_WIDTH * height),
        "SPLAT_SIZE": SPLAT_SIZE,
        "COMPARES": int(compares),
        "OPACITIES": int(opacities),
    }
    for constant, value in values.items():
        text = re.sub(rf"\b{constant}\b", str(value), text)
    return text


ARGUMENTS = {
    **dict.fromkeys(("tile", "thread", "width", "height"), int),
    **dict.fromkeys(("alpha_min", "alpha_max", "transmittance_min"), float),
    "splats": wp.array3d(dtype=float),  # (I, G, SPLAT_SIZE)
    "ids": wp.array(dtype=int),  # (N,)
    "starts": wp.array(dtype=int),  # (tiles + 1,)
    "background": wp.array(dtype=float),  # (3,)
    "pictures": wp.array4d(dtype=float),  # (I, H, W, 3), out
    "alphas": wp.array3d(dtype=float),  # (I, H, W), out
    "transmittances": wp.array3d(dtype=float),  # (I, H, W), out; undefined in tiles without splats
    "observed": wp.array3d(dtype=int),  # (I, H, W)
    "sums": wp.array2d(dtype=wp.float64),  # (tiles, warps), out
    "states": wp.array3d(dtype=float),  # (tiles, pixels, 4), out; undefined in tiles without splats
    "scales": wp.array(dtype=float),  # (I,)
    "grad_pictures": wp.array4d(dtype=float),  # (I, H, W, 3)
    "grad_alphas": wp.array3d(dtype=float),  # (I, H, W)
    "grad_splats": wp.array3d(dtype=float),  # (I, G, SPLAT_SIZE), out: sums for `finish`, added
}
"""Types of the arguments of the kernels below by name. They are launched with a block of threads per tile, on CUDA
only. All threads of a block must enter, so that warps are complete."""


@functools.cache
def kernels(tile: int, lane_pixels: int):
    """``(composite, composite_adjoint, threads)`` for blocks of ``threads``."""
    threads = tile * tile // lane_pixels
    own = typed(
        ARGUMENTS | {"stops": wp.array3d(dtype=int)}
    )  # (I, H, W), out; undefined in tiles without splats
    kernel = own.kernel(wp.get_module(f"{__name__}.tile{tile}x{lane_pixels}"), launch_bounds=threads)

    @own.func_native(source("forward", tile, lane_pixels))
    def composite_patch(
        tile, thread, width, height, splats, ids, starts, alpha_min, alpha_max, transmittance_min, background,
        pictures, alphas, transmittances, stops,
    ): ...  # fmt: skip

    @own.func_native(source("backward", tile, lane_pixels))
    def composite_patch_adjoint(
        tile, thread, width, height, splats, ids, starts, transmittances, stops, alpha_min, alpha_max, background,
        grad_pictures, grad_alphas, grad_splats,
    ): ...  # fmt: skip

    @kernel
    def composite(
        splats, ids, starts, alpha_min, alpha_max, transmittance_min, background, pictures, alphas, transmittances,
        stops,
    ):  # fmt: skip
        i = wp.tid()
        composite_patch(
            i // threads, i % threads, alphas.shape[2], alphas.shape[1], splats, ids, starts, alpha_min, alpha_max,
            transmittance_min, background, pictures, alphas, transmittances, stops,
        )  # fmt: skip

    @kernel
    def composite_adjoint(
        splats, ids, starts, transmittances, stops, alpha_min, alpha_max, background, grad_pictures, grad_alphas,
        grad_splats,
    ):  # fmt: skip
        i = wp.tid()
        composite_patch_adjoint(
            i // threads, i % threads, grad_alphas.shape[2], grad_alphas.shape[1], splats, ids, starts,
            transmittances, stops, alpha_min, alpha_max, background, grad_pictures, grad_alphas, grad_splats,
        )  # fmt: skip

    return composite, composite_adjoint, threads


@functools.cache
def comparing_kernel(tile: int, lane_pixels: int):
    """``(compare, threads)``: as `kernels`, for the comparison with observed pixels."""
    threads = tile * tile // lane_pixels
    own = typed(ARGUMENTS | {"stops": wp.array2d(dtype=int)})  # (tiles, pixels), as above
    kernel = own.kernel(wp.get_module(f"{__name__}.tile{tile}x{lane_pixels}.compare"), launch_bounds=threads)

    @own.func_native(source("forward", tile, lane_pixels, compares=True))
    def compare_patch(
        tile, thread, width, height, splats, ids, starts, alpha_min, alpha_max, transmittance_min, background,
        observed, sums, states, stops,
    ): ...  # fmt: skip

    @kernel
    def compare(
        splats, ids, starts, alpha_min, alpha_max, transmittance_min, background, observed, sums, states, stops,
    ):  # fmt: skip
        i = wp.tid()
        compare_patch(
            i // threads, i % threads, observed.shape[2], observed.shape[1], splats, ids, starts, alpha_min, alpha_max,
            transmittance_min, background, observed, sums, states, stops,
        )  # fmt: skip

    return compare, threads


@functools.cache
def comparing_adjoint(tile: int, lane_pixels: int, opacities: bool):
    """``(compare_adjoint, threads)``, with or without the sum for gradients of opacities."""
    threads = tile * tile // lane_pixels
    own = typed(ARGUMENTS | {"stops": wp.array2d(dtype=int)})  # (tiles, pixels), as above
    module = wp.get_module(f"{__name__}.tile{tile}x{lane_pixels}.compare_adjoint{int(opacities)}")

    @own.func_native(source("backward", tile, lane_pixels, True, opacities))
    def compare_patch_adjoint(
        tile, thread, width, height, splats, ids, starts, states, stops, alpha_min, alpha_max, background, scales,
        grad_splats,
    ): ...  # fmt: skip

    @own.kernel(module, launch_bounds=threads)
    def compare_adjoint(
        splats, ids, starts, states, stops, alpha_min, alpha_max, background, width, height, scales, grad_splats,
    ):  # fmt: skip
        i = wp.tid()
        compare_patch_adjoint(
            i // threads, i % threads, width, height, splats, ids, starts, states, stops, alpha_min, alpha_max,
            background, scales, grad_splats,
        )  # fmt: skip

    return compare_adjoint, threads
