"""Neural constitutive law as one CUDA kernel forward and one backward: features, network, stress.

The reference in :mod:`neuma_lib.mechanics.neural` writes every activation to memory and launches dozens of kernels.
These kernels (``neural_fused.cu``) read only F, write only the result, and recompute activations in the backward pass.

A warp owns one or two tiles of 16 rows. Each lane computes the features and the final output of one row, and the tensor
cores compute the matrix products of a tile. The accumulators of a layer have the operand layout of the next layer, so
activations stay in registers.

**Precision.** Each factor is scaled by a power of two (per weight matrix, and per activation of a warp) and split into
two halves of 11 bits, x = hi + lo. The sum lo hi + hi lo + hi hi, accumulated in float32, has 22 bits. This costs half
as much as the same split in TF32, and the scale compensates for the small exponent range of float16. With precision
"half", the backward pass uses only hi hi, a third of the products, for gradients and the recomputed network, which then
have 11 bits. Sums, singular values and rotations stay in float32, with square roots and quotients to two units in the
last place.

**Weight gradients** are products over rows, G^T H. The warps of a block store G and H, already split, in shared memory
and compute one slice of the result each. Blocks write separate partial sums, and a second kernel adds them in a fixed
order, after each call or after many calls that accumulate in :func:`partial_sums`.
"""

from functools import cache

import torch
import warp as wp
from torch import Tensor

from neuma_lib.device import native_source
from neuma_lib.mechanics.fused_launch import (
    BLOCKS_PER_PROCESSOR,
    addressed,
    block_count,
    contiguous,
    launch_blocks,
    warp_device,
)
from neuma_lib.mechanics.law import Weights
from neuma_lib.mechanics.neural_vector import FEATURES, GRAM
from neuma_lib.mechanics.singular_values_kernels import SVD, SWEEPS

ROWS = 128  # rows per block
EVALUATE_TILES, VJP_TILES = 2, 1
"""Tiles of 16 rows per warp, forward and backward. One tile gives twice as many warps with half the registers, which
hides more latency for few rows, but two lanes then compute the features and stress of each row redundantly."""
HIDDEN, OUTPUTS = 64, 9
WEIGHTS = HIDDEN * (FEATURES + HIDDEN + OUTPUTS)
ALIGNMENT = 128  # largest number of bytes of shared memory lost to alignment

# Byte offsets in shared memory. A matrix of halves consists of its high parts followed by its low parts. The order of
# the chunks of eight halves in a row (128 bytes for 64 columns, 32 bytes for 16) depends on the row, so that ldmatrix,
# which reads one chunk of eight rows at once, has no bank conflicts.
LAYOUT = {
    "W0_AT": 0,  # (64, 16)
    "W1_AT": 4096,  # (64, 64)
    "W2_AT": 20480,  # (16, 64)
    "PEAKS_AT": 24576,  # largest weights, three numbers per warp
    "DOWNS_AT": 24640,  # scales of the activations, six numbers for each of eight warps
    "Z_AT": 24832,  # features (128, 16)
    "ROW_AT": 33024,  # forward only: output of the network by row
    "S0_AT": 33024,  # backward only: output of the network and its gradient, then h0 (128, 64)
    "GY_AT": 49408,  # (128, 16), in the second half of S0
    "S1_AT": 65792,  # h1, then g1, then g0 (128, 64)
    "STATE_AT": 98560,  # 27 floats per row
}
CONSTANTS = {
    **LAYOUT,
    # bytes per row of halves
    "ROW16": 2 * 16,
    "ROW64": 2 * 64,
    # byte offset of the low parts of a matrix: weights, and ROWS rows of 16 or 64 columns
    "W0_LOW": 2 * 64 * 16,
    "W1_LOW": 2 * 64 * 64,
    "W2_LOW": 2 * 16 * 64,
    "LOW16": 2 * ROWS * 16,
    "LOW64": 2 * ROWS * 64,
    # floats between rows of the output of the network, and of its gradient with respect to the features
    "ROW_STRIDE": FEATURES,
    # numbers per row stored by the backward pass: R, V, and sums of singular values, then part of the gradient
    "STATE_R": 0,
    "STATE_V": 9,
    "STATE_TURN": 18,
    # offsets of the weight matrices in one array
    "W1_START": HIDDEN * FEATURES,
    "W2_START": HIDDEN * (FEATURES + HIDDEN),
    "WEIGHTS": WEIGHTS,
    "ROWS": ROWS,
    "FEATURES": FEATURES,
    "HIDDEN": HIDDEN,
    "OUTPUTS": OUTPUTS,
    "SWEEPS": SWEEPS[torch.float32],
}
EVALUATE_BYTES = LAYOUT["ROW_AT"] + 4 * CONSTANTS["ROW_STRIDE"] * ROWS + ALIGNMENT
VJP_BYTES = LAYOUT["STATE_AT"] + 4 * 27 * ROWS + ALIGNMENT


def threads(tiles: int) -> int:
    """Threads per block for warps with ``tiles`` tiles of 16 rows."""
    return 32 * ROWS // (16 * tiles)


def _loads(threads: int) -> dict[str, int]:
    """Loads per thread: single weights of the first matrix, pairs of the others (the last padded to 16 rows)."""
    counts = {"W0": HIDDEN * FEATURES, "W1": HIDDEN * HIDDEN // 2, "W2": 16 * HIDDEN // 2}
    return {f"{name}_LOADS": -(-count // threads) for name, count in counts.items()}


def _constants(values: dict[str, int]) -> str:
    return "".join(f"    const int {name} = {value};\n" for name, value in values.items())


def source(kind: str, backward: bool, machine: str | None = None, precision: str = "single") -> str:
    """C++ source of the body of a kernel for ``kind`` "elasticity" or "plasticity".

    ``machine`` replaces the part of the ``.cu`` file of that name. ``precision`` of the products is "single" or "half".
    """
    tiles = VJP_TILES if backward else EVALUATE_TILES
    size = threads(tiles)
    parts = native_source(__file__)
    floor = torch.finfo(torch.float32).eps ** 0.5
    constants = _constants(
        {**CONSTANTS, **_loads(size), "TILES": tiles, "THREADS": size, "WARPS": size // 32}
    )
    for name, value in {"ELASTIC": kind == "elasticity", "HALF": precision == "half"}.items():
        constants += f"    const bool {name} = {str(value).lower()};\n"
    constants += f"    const float FLOOR = {floor!r}f;\n"
    prefetch = "prefetch((const float*)grad_out + 9 * (size_t)row);" if backward else ""
    features = parts["features"].replace("{GRAM}", GRAM).replace("{SVD}", SVD).replace("{PREFETCH}", prefetch)
    rest = ("put_down", "layers", "vjp") if backward else ("layers", "evaluate")
    body = "".join(parts[name] for name in (*rest, "end"))
    return constants + (machine or parts["machine"]) + parts["tools"] + features + body


@cache
def evaluate_kernel(kind: str):
    """Kernel (F, W0, W1, W2, factor, n, out) over blocks of :data:`ROWS` rows."""

    own = addressed(factor=float, n=int, shared=wp.tile(dtype=wp.uint8, shape=(EVALUATE_BYTES,)))

    @own.func_native(source(kind, backward=False))
    def evaluate_rows(F, W0, W1, W2, factor, n, out, shared): ...

    @own.kernel("unique", launch_bounds=(threads(EVALUATE_TILES), BLOCKS_PER_PROCESSOR), grid_stride=False)
    def neural_evaluate(F, W0, W1, W2, factor, n, out):
        shared = wp.tile_empty(shape=(EVALUATE_BYTES,), dtype=wp.uint8, storage="shared")
        evaluate_rows(F, W0, W1, W2, factor, n, out, shared)

    return neural_evaluate


@cache
def vjp_kernel(kind: str, precision: str = "single"):
    """Kernel (F, W0, W1, W2, grad_out, factor, n, grad_F, fresh, partials (blocks, WEIGHTS)) over blocks of rows.

    It overwrites ``partials`` if ``fresh``, and adds to them otherwise.
    """

    own = addressed(factor=float, n=int, fresh=int, shared=wp.tile(dtype=wp.uint8, shape=(VJP_BYTES,)))

    @own.func_native(source(kind, backward=True, precision=precision))
    def vjp_rows(F, W0, W1, W2, grad_out, factor, n, grad_F, fresh, partials, shared): ...

    @own.kernel("unique", launch_bounds=(threads(VJP_TILES), BLOCKS_PER_PROCESSOR), grid_stride=False)
    def neural_vjp(F, W0, W1, W2, grad_out, factor, n, grad_F, fresh, partials):
        shared = wp.tile_empty(shape=(VJP_BYTES,), dtype=wp.uint8, storage="shared")
        vjp_rows(F, W0, W1, W2, grad_out, factor, n, grad_F, fresh, partials, shared)

    return neural_vjp


@cache
def add_kernel():
    """Kernel (partials (blocks, WEIGHTS), blocks, three accumulators) that adds the sums over blocks."""

    own = addressed(blocks=int)

    @own.func_native(_constants(CONSTANTS) + native_source(__file__)["add"])
    def add_columns(partials, blocks, total0, total1, total2): ...

    @own.kernel("unique", grid_stride=False)
    def neural_add(partials, blocks, total0, total1, total2):
        add_columns(partials, blocks, total0, total1, total2)

    return neural_add


@cache
def supported(device: torch.device, dtype: torch.dtype) -> bool:
    """Whether these kernels run: float32 on a GPU with float16 tensor cores and enough shared memory."""
    if device.type != "cuda" or dtype != torch.float32:
        return False
    gpu = warp_device(device)
    return gpu.arch >= 80 and gpu.max_shared_memory_per_block >= VJP_BYTES + 4 * threads(VJP_TILES)


def _blocks(F: Tensor) -> int:
    return block_count(len(F), ROWS, F.device)


def _packed(weights: Weights) -> list[Tensor]:
    """Weights as the kernels read them: contiguous, with pairs of numbers at multiples of 8 bytes."""
    weights = [w.detach().contiguous() for w in weights]
    return [w.clone() if w.data_ptr() % 8 else w for w in weights]


@torch.no_grad()
def evaluate(F: Tensor, weights: Weights, kind: str, factor: float, out: Tensor | None = None) -> Tensor:
    """Evaluate the law of ``kind`` at F (n, 3, 3), plasticity as F + factor R X. See :class:`Constitutive`."""
    F = F.detach().contiguous()
    out = torch.empty_like(F) if out is None else out
    with contiguous(out) as (result,):
        if len(F):
            inputs = (F, *_packed(weights), factor, len(F), result)
            launch_blocks(evaluate_kernel(kind), _blocks(F), threads(EVALUATE_TILES), *inputs)
    return out


@torch.no_grad()
def vjp(
    F: Tensor,
    weights: Weights,
    grad_out: Tensor,
    kind: str,
    factor: float,
    grad_F: Tensor | None = None,
    grad_weights: Weights | None = None,
    precision: str = "single",
) -> tuple[Tensor, Weights]:
    """Gradients of F and, added to ``grad_weights``, of the weights. See :class:`Constitutive`.

    ``grad_weights`` may be :func:`partial_sums`. ``precision`` is :attr:`Constitutive.adjoint_precision`.
    """
    F, grad_out = F.detach().contiguous(), grad_out.contiguous()
    grad_F = torch.empty_like(F) if grad_F is None else grad_F
    W = _packed(weights)
    totals = tuple(torch.zeros_like(w) for w in W) if grad_weights is None else grad_weights
    if len(F):
        blocks, fresh = _blocks(F), len(totals) == len(W)
        partials = F.new_empty(blocks, WEIGHTS) if fresh else totals[0]
        with contiguous(grad_F) as (result,):
            inputs = (F, *W, grad_out, factor, len(F), result, int(fresh), partials)
            launch_blocks(vjp_kernel(kind, precision), blocks, threads(VJP_TILES), *inputs)
        if fresh:
            add_up(partials, totals)
    return grad_F, totals


def partial_sums(F: Tensor) -> Tensor:
    """Zero gradients of the weights for each block of `vjp` at F (n, 3, 3), shape (blocks, WEIGHTS)."""
    return F.new_zeros(_blocks(F), WEIGHTS)


@torch.no_grad()
def add_up(partials: Tensor, totals: Weights) -> None:
    """Add the sums over the blocks to the gradients of the three weight matrices."""
    with contiguous(*totals) as sums:
        launch_blocks(add_kernel(), WEIGHTS // 32, 1024, partials, len(partials), *sums)
