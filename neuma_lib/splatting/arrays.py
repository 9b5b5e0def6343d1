"""Torch tensors as the arguments of Warp kernels."""

from __future__ import annotations

import torch
import warp as wp

from neuma_lib.device import warp_stream


def plain(tensor: torch.Tensor) -> wp.array:
    """A tensor as an array of numbers."""
    return wp.from_torch(tensor, requires_grad=False)


def vectors(tensor: torch.Tensor) -> wp.array:
    """A (..., 3) tensor as an array of vectors."""
    real = wp.dtype_from_torch(tensor.dtype)
    return wp.from_torch(tensor, dtype=wp.types.vector(3, real), requires_grad=False)


def matrices(tensor: torch.Tensor) -> wp.array:
    """A (..., n, n) tensor as an array of matrices."""
    real = wp.dtype_from_torch(tensor.dtype)
    size = tensor.shape[-1]
    return wp.from_torch(tensor, dtype=wp.types.matrix((size, size), real), requires_grad=False)


def target(tensor: torch.Tensor) -> dict:
    """Arguments of ``wp.launch`` that queue a kernel on the tensor's device, in order with torch."""
    return {"device": wp.device_from_torch(tensor.device), "stream": warp_stream(tensor.device)}
