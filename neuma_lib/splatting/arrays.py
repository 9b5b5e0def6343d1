"""Checks of the tensors that Warp kernels work on."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from neuma_lib.errors import InputError


def check_tensors(
    user: str, expected: Mapping[str, tuple[Tensor, tuple[int, ...]]], advice: str = ""
) -> None:
    """Raise InputError unless each tensor has its expected shape and the dtype and device of the first."""
    first, (like, _) = next(iter(expected.items()))
    for name, (value, shape) in expected.items():
        if tuple(value.shape) != shape:
            raise InputError(f"{user}: {name} has shape {tuple(value.shape)}, expected {shape}{advice}")
        if value.dtype != like.dtype or value.device != like.device:
            raise InputError(
                f"{user}: {name} is {value.dtype} on {value.device}, {first} is {like.dtype} on {like.device}: "
                "give all alike"
            )
