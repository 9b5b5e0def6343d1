"""Functions whose value at a frame depends on the state of that frame alone, a few frames at a time.

Autograd would keep what every frame needs for its gradient until the backward pass: for renders of 400 frames, tens of
gigabytes. Here gradients with respect to the states are taken while a part is still at hand. They are small, and the
backward pass only weights them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from torch import Tensor


def frame_batches(count: int, size: int) -> Iterator[slice]:
    """Consecutive ranges of at most ``size`` frames that cover ``count``, as equal in length as can be."""
    pieces = max(1, -(-count // size))
    edges = [piece * count // pieces for piece in range(pieces + 1)]
    return (slice(first, last) for first, last in zip(edges, edges[1:], strict=False))


def spread_frames(count: int, most: int) -> list[int]:
    """At most ``most`` of ``count`` frames, evenly spread, first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()


def evaluate_in_batches(function: Callable[..., Tensor], size: int, *states: Tensor) -> Tensor:
    """``function`` of T frames, evaluated on ``size`` frames at a time; differentiable in the states, once.

    Args:
        function: called as ``function(part, *states_of_part)`` with a slice of the frames; returns one number a frame,
            shape (t,), each of which depends on its own frame's states only. Gradients reach nothing but the states.
        size: most frames of a part.
        states: tensors whose first axis is the frames, T of them.

    Returns:
        All values, shape (T,).
    """
    if torch.is_grad_enabled() and any(state.requires_grad for state in states):
        return _EvaluateInBatches.apply(function, size, *states)
    return torch.cat(
        [function(part, *(s[part] for s in states)) for part in frame_batches(len(states[0]), size)]
    )


class _EvaluateInBatches(torch.autograd.Function):
    @staticmethod
    def forward(ctx, function, size, *states):
        wanted = [i for i, needed in enumerate(ctx.needs_input_grad[2:]) if needed]
        grads: list[Tensor | None] = [None] * len(states)
        values = []
        for part in frame_batches(len(states[0]), size):
            value, found = _value_and_gradients(function, part, states, wanted)
            values.append(value)
            for i, grad in zip(wanted, found, strict=True):
                if grad is None:
                    continue
                if grads[i] is None:
                    grads[i] = torch.zeros_like(states[i], memory_format=torch.contiguous_format)
                grads[i][part] = grad
        ctx.save_for_backward(*grads)
        return torch.cat(values)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, weight):
        grads = ctx.saved_tensors
        return None, None, *(None if g is None else g * weight.view(-1, *[1] * (g.ndim - 1)) for g in grads)


def _value_and_gradients(
    function: Callable[..., Tensor], part: slice, states: Sequence[Tensor], wanted: Sequence[int]
) -> tuple[Tensor, tuple[Tensor | None, ...]]:
    """Values of the frames of a part, and their gradients with respect to the wanted states; nothing else is kept."""
    inputs = [state[part].detach() for state in states]
    leaves = [inputs[i].requires_grad_() for i in wanted]
    with torch.enable_grad():
        value = function(part, *inputs)
    grads = torch.autograd.grad(value, leaves, torch.ones_like(value), allow_unused=True)
    return value.detach(), grads
