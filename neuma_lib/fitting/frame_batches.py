"""Frames of a video: which are compared, which are held out, and evaluation of functions of frames in batches.

For renders of 400 frames, autograd would keep tens of gigabytes until the backward pass. `evaluate_in_batches` computes
the gradients with respect to the states batch by batch, and the backward pass only weights them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from neuma_lib.sim.model import MPM, contact_clearance


def frame_batches(count: int, size: int) -> Iterator[slice]:
    """Consecutive ranges of at most ``size`` frames and nearly equal length that cover ``count`` frames."""
    pieces = max(1, -(-count // size))
    edges = [piece * count // pieces for piece in range(pieces + 1)]
    return (slice(first, last) for first, last in zip(edges, edges[1:], strict=False))


def spread_frames(count: int, limit: int) -> list[int]:
    """At most ``limit`` of ``count`` frames, evenly spaced, including first and last."""
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(int)).tolist()


def first_contact(model: MPM, x: Tensor, vol0: Tensor, steps: Sequence[int] = (0,)) -> int:
    """Index of the first frame of positions x (T, N, 3) [m] with a particle in contact, T if none.

    Args:
        vol0, steps: as for `contact_clearance`.
    """
    touching = contact_clearance(model, x, vol0, steps) <= 0
    return int(touching.int().argmax()) if bool(touching.any()) else len(x)


def held_out_frames(count: int, share: float, blocks: int = 1, contact: int = 0) -> list[int]:
    """Indices of the held-out frames: the last ones, at least one, of each of several equal blocks of the video.

    Args:
        count: number of frames of the video.
        share: share of the frames after the contact.
        blocks: number of blocks.
        contact: index of the first informative frame. Earlier frames are ignored unless fewer than two remain.
    """
    first = contact if count - contact >= 2 else 0
    informative = count - first
    blocks = min(blocks, informative // 2)
    ends = [first + round(k * informative / blocks) for k in range(blocks + 1)]
    size = max(1, round(share * informative / blocks))
    return [frame for start, end in pairwise(ends) for frame in range(max(start + 1, end - size), end)]


def evaluate_in_batches(function: Callable[..., Tensor], size: int, *states: Tensor) -> Tensor:
    """Evaluate ``function`` of T frames in batches of at most ``size`` frames; differentiable once in the states.

    Args:
        function: called as ``function(batch, *states_of_batch)`` with a slice of the frames; returns one number per
            frame, shape (t,), that depends only on the states of that frame. Only the states have gradients.
        size: maximum number of frames per batch.
        states: tensors whose first axis is the frames.

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
            value, batch_grads = _value_and_gradients(function, part, states, wanted)
            values.append(value)
            for i, grad in zip(wanted, batch_grads, strict=True):
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
    """Values of the frames of a batch, and their gradients with respect to the wanted states."""
    inputs = [state[part].detach() for state in states]
    leaves = [inputs[i].requires_grad_() for i in wanted]
    with torch.enable_grad():
        value = function(part, *inputs)
    grads = torch.autograd.grad(value, leaves, torch.ones_like(value), allow_unused=True)
    return value.detach(), grads
