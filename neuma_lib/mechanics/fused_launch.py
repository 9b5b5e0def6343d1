"""Launches of fused kernels, which take arrays as addresses: Warp's array objects take more time than the kernels."""

import threading
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from types import SimpleNamespace

import torch
import warp as wp
from torch import Tensor

from neuma_lib.device import typed, warp_stream

BLOCKS_PER_PROCESSOR = 2


def addressed(**types: type) -> SimpleNamespace:
    """`neuma_lib.device.typed` for arguments of these types, and arrays as addresses for all others."""
    return typed(defaultdict(lambda: wp.uint64, types))


@cache
def warp_device(device: torch.device) -> wp.Device:
    """Warp's view of a device."""
    return wp.device_from_torch(device)


def block_count(rows: int, rows_per_block: int, device: torch.device) -> int:
    """Thread blocks on a GPU for a number of rows, at most `BLOCKS_PER_PROCESSOR` per processor."""
    return min(-(-rows // rows_per_block), BLOCKS_PER_PROCESSOR * warp_device(device).sm_count)


def launch_blocks(kernel: wp.Kernel, blocks: int, threads: int, *inputs: Tensor | float | None) -> None:
    """Queue a kernel over blocks of threads, in order with torch. On a CPU a block has one thread.

    Raises:
        TypeError: tensors differ in dtype or device, which addresses do not show.
    """
    first, *others = (x for x in inputs if isinstance(x, Tensor))
    if any(x.dtype != first.dtype or x.device != first.device for x in others):
        raise TypeError("F, weights and buffers of a law must have one dtype and one device")
    values = [x.data_ptr() if isinstance(x, Tensor) else 0 if x is None else x for x in inputs]
    if first.device.type == "cpu":
        _launch_on_cpu(kernel, blocks, values)
        return
    device, stream = warp_device(first.device), warp_stream(first.device)
    wp.launch(kernel, dim=blocks * threads, inputs=values, block_dim=threads, device=device, stream=stream)


_recorded = threading.local()


def _launch_on_cpu(kernel: wp.Kernel, blocks: int, values: Sequence[float]) -> None:
    """Launch with one thread per block, in a third of the time of `wp.launch`: a recorded launch with new arguments.

    Every thread of Python has its own, because the arguments are part of it.
    """
    launches = _recorded.__dict__
    key = kernel, blocks
    if key not in launches:
        launches[key] = wp.launch(
            kernel, dim=blocks, inputs=values, block_dim=1, device="cpu", record_cmd=True
        )
    launches[key].set_params_from_ctypes(values)
    launches[key].launch()


@contextmanager
def contiguous(*tensors: Tensor) -> Iterator[list[Tensor]]:
    """Contiguous views or copies of tensors that a kernel writes. Copies are written back at the end."""
    buffers = [tensor.contiguous() for tensor in tensors]
    yield buffers
    for tensor, buffer in zip(tensors, buffers, strict=True):
        if buffer is not tensor:
            tensor.copy_(buffer)
