"""Where to compute, and the one place that starts Warp: quiet, with a kernel cache that several processes can share.

The cache folder is taken from the environment variable ``NEUMA_KERNEL_CACHE`` when it is set (the workflow sets
it to a folder of the project and fills it by one warm-up rule, so that two jobs never compile the same kernels);
otherwise Warp's own per-user cache is used.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import torch
import warp as wp

from neuma_lib.errors import InputError

_started = False


def choose_device(name: str = "auto") -> torch.device:
    """The device of that name; "auto" takes CUDA where there is one.

    Raises:
        InputError: CUDA is asked for and torch sees none.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError(
            "device: cuda is asked for, but torch sees no CUDA device; set device: cpu, or mend the driver"
        )
    return torch.device(name)


def start_warp() -> None:
    """Start Warp once per process. Safe to call from every module that defines kernels."""
    global _started
    if _started:
        return
    wp.config.log_level = wp.LOG_WARNING
    cache = os.environ.get("NEUMA_KERNEL_CACHE")
    if cache:
        wp.config.kernel_cache_dir = cache
    with _without_driver_warning():
        wp.init()
    _started = True


@contextmanager
def _without_driver_warning() -> Iterator[None]:
    """On a machine without a GPU Warp's native code warns on standard error, once in every process: leave that out."""
    if torch.cuda.is_available():
        yield
        return
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


@cache
def native_source(module: str, suffix: str = ".cu") -> dict[str, str]:
    """C++ or CUDA text beside a module (its ``__file__``), for `wp.func_native`: parts by name.

    A line ``//// name`` opens a part; what stands before the first is a comment.
    """
    _, *parts = re.split(r"^//// (\w+)\n", Path(module).with_suffix(suffix).read_text(), flags=re.MULTILINE)
    return dict(zip(parts[::2], parts[1::2], strict=True))


def warp_stream(device: torch.device) -> wp.Stream | None:
    """Warp's view of torch's current stream, so that kernels queue in order with torch; None on the CPU."""
    return None if device.type == "cpu" else wp.stream_from_torch(torch.cuda.current_stream(device))


def launch(kernel: wp.Kernel, dim: int | Sequence[int], *arguments, block_dim: int = 256) -> None:
    """Queue a Warp kernel on the device of its first tensor, in order with torch.

    Tensors become arrays of what the kernel takes: numbers, or the vectors or matrices in their last dimensions.
    """
    device = next(a.device for a in arguments if isinstance(a, torch.Tensor))
    inputs = [  # descriptors instead of Warp's array objects: these would cost more time than the launch
        wp.from_torch(a, p.type.dtype, requires_grad=False, return_ctype=True) if torch.is_tensor(a) else a
        for a, p in zip(arguments, kernel.adj.args)
    ]
    wp.launch(
        kernel,
        dim=dim,
        inputs=inputs,
        block_dim=block_dim,
        device=wp.device_from_torch(device),
        stream=warp_stream(device),
    )


def sort_pairs(keys: torch.Tensor, values: torch.Tensor, count: int, bits: int = 32) -> None:
    """Sort the first ``count`` pairs stably by the lowest bits of their keys, in place, in order with torch.

    Reads and writes less than ``torch.sort``, whose keys count whole and whose values are 64-bit indices.

    Args:
        keys: float32 or int32, shape (2 count,), not negative; the second half is scratch.
        values: int32, likewise.
        count: how many pairs there are.
        bits: all that keys have; higher ones are 0.
    """
    with wp.ScopedStream(warp_stream(keys.device), sync_enter=False):
        wp.utils.radix_sort_pairs(wp.from_torch(keys), wp.from_torch(values), count, end_bit=bits)
