"""Frames of a video: which are compared, which judge, and functions of one frame each, a few frames at a time.

Autograd would keep what every frame needs for its gradient until the backward pass: for renders of 400 frames, tens of
gigabytes. Here gradients with respect to the states are taken while a part is still at hand. They are small, and the
backward pass only weights them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from neuma_lib.sim.model import MPM, contact_clearance


def frame_batches(count: int, size: int) -> Iterator[slice]:
    """Consecutive ranges of at most ``size`` frames that cover ``count``, as equal in length as can be."""
    pieces = max(1, -(-count // size))
    edges = [piece * count // pieces for piece in range(pieces + 1)]
    return (slice(first, last) for first, last in zip(edges, edges[1:], strict=False))


def spread_frames(count: int, most: int) -> list[int]:
    """At most ``most`` of ``count`` frames, evenly spread, first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()


def first_contact(model: MPM, x: Tensor) -> int:
    """Index of the first frame in which a particle feels a wall, of positions x (T, N, 3) [m]; T if there is none."""
    touching = contact_clearance(model, x) <= 0
    return int(touching.int().argmax()) if bool(touching.any()) else len(x)


def held_out_frames(count: int, share: float, blocks: int = 1, contact: int = 0) -> list[int]:
    """Indices of the frames that judge: the last ones of each of some equal parts of the video, one at least each.

    Args:
        count: frames of the video.
        share: part of what follows the contact.
        blocks: number of the parts.
        contact: index of the first frame that tells of the law; frames before it are left out, unless fewer than two
            remain.
    """
    first = contact if count - contact >= 2 else 0
    told = count - first
    blocks = min(blocks, told // 2)
    ends = [first + round(k * told / blocks) for k in range(blocks + 1)]
    size = max(1, round(share * told / blocks))
    return [frame for start, end in pairwise(ends) for frame in range(max(start + 1, end - size), end)]


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
