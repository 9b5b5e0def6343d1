"""Checks of the tensors passed to Warp kernels."""

from collections.abc import Mapping

from torch import Tensor

from neuma_lib.errors import InputError


def check_tensors(
    function: str, expected: Mapping[str, tuple[Tensor, tuple[int, ...]]], remedy: str = ""
) -> None:
    """Raise InputError unless each tensor has its expected shape and the dtype and device of the first."""
    first, (like, _) = next(iter(expected.items()))
    for name, (value, shape) in expected.items():
        if tuple(value.shape) != shape:
            problem = f"has shape {tuple(value.shape)}, expected {shape}"
            raise InputError(f"{function}: {name}", problem, remedy)
        if value.dtype != like.dtype or value.device != like.device:
            problem = f"is {value.dtype} on {value.device}, but {first} is {like.dtype} on {like.device}"
            raise InputError(f"{function}: {name}", problem)
