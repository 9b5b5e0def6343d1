"""Device of a computation, start of Warp, and launches of kernels in the order of torch's stream.

Compiled kernels are cached in the folder of the environment variable ``NEUMA_KERNEL_CACHE``, or else in Warp's cache of
the user. The workflow sets it to a folder of the project, which one job fills, so that no two jobs compile the same
kernels.
"""

import inspect
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
import warp as wp

from neuma_lib.errors import InputError


def choose_device(name: str = "auto") -> torch.device:
    """The device of a name; "auto" is CUDA if it is available. Raises InputError if torch finds no CUDA device."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError("device", "torch sees no CUDA device", "Set device: cpu, or repair the driver")
    return torch.device(name)


@cache
def start_warp() -> None:
    """Initialise Warp. Every module that defines kernels calls it; only the first call has an effect."""
    wp.config.log_level = wp.LOG_WARNING
    if folder := os.environ.get("NEUMA_KERNEL_CACHE"):
        wp.config.kernel_cache_dir = folder
    with _without_driver_warning():
        wp.init()


@contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Discard the warning that Warp's native code writes to standard error on a machine without a GPU."""
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
    """Parts by name of the C++ or CUDA source next to a module (its ``__file__``), for `wp.func_native`.

    A line ``//// name`` starts a part. Text before the first is a comment.
    """
    _, *parts = re.split(r"^//// (\w+)\n", Path(module).with_suffix(suffix).read_text(), flags=re.MULTILINE)
    return dict(zip(parts[::2], parts[1::2], strict=True))


def typed(types: Mapping[str, Any]) -> SimpleNamespace:
    """Decorators of Warp that add the types of arguments without an annotation, by their names.

    Returns:
        ``func``, ``func_native(source)``, and ``kernel(module, **options)`` without automatic adjoints.
    """

    def annotate(function: Callable) -> Callable:
        own, names = function.__annotations__, inspect.signature(function).parameters
        # Warp reads their order, too.
        function.__annotations__ = {n: own[n] if n in own else types[n] for n in names} | own
        return function

    # Warp finds the type of a native function's result if its only decorator is called func_native.
    return SimpleNamespace(
        func=lambda function: wp.func(annotate(function)),
        func_native=lambda source: lambda function: wp.func_native(source)(annotate(function)),
        kernel=lambda module, **options: (
            lambda function: wp.kernel(annotate(function), enable_backward=False, module=module, **options)
        ),
    )


def warp_stream(device: torch.device) -> wp.Stream | None:
    """torch's current stream for Warp, so that kernels run in order with torch. None on the CPU."""
    return None if device.type == "cpu" else wp.stream_from_torch(torch.cuda.current_stream(device))


def launch(kernel: wp.Kernel, dim: int | Sequence[int], *arguments, block_dim: int = 256) -> None:
    """Queue a Warp kernel on the device of its first tensor, in order with torch.

    Tensors are converted to arrays of numbers, or of the vectors or matrices in their last dimensions.
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

    Transfers less memory than ``torch.sort``, which sorts by all bits and returns 64-bit indices.

    Args:
        keys: float32 or int32, shape (2 count,), not negative; the second half is scratch.
        values: int32, of the same shape.
        bits: number of lowest bits that may be set in keys.
    """
    with wp.ScopedStream(warp_stream(keys.device), sync_enter=False):
        wp.utils.radix_sort_pairs(wp.from_torch(keys), wp.from_torch(values), count, end_bit=bits)
