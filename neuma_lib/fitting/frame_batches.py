"""Frames of a video: which are compared, which are held out, and evaluation of functions of frames in batches.

For renders of 400 frames, autograd would keep tens of gigabytes until the backward pass. `evaluate_in_batches` computes
the gradients with respect to the states batch by batch, and the backward pass only weights them.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.sim.model import MPM, contact_clearance, model_of_each
from neuma_lib.sim.state import State


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


def check_contact(model: MPM | Sequence[MPM], videos: Iterable[tuple[State, Sequence[int]]]) -> None:
    """Check that a body touches a wall or is clamped within a video, since free flight is the same for all materials.

    The motion before contact is known in closed form: a parabola and, up to the small stretch by a spin, a rotation.

    Args:
        model: simulator constants, of all videos or of each.
        videos: initial state of the body and steps of the frames of each video.

    Raises:
        InputError: no body touches a wall before the last frame of its video.
    """
    ends, videos = [], list(videos)
    for own, (start, frames) in zip(model_of_each(model, len(videos)), videos, strict=True):
        ends.append((own, start, last := frames[-1]))
        if own.clamps or any(_touches(own, start, n) for n in (last, *frames)):
            return
    model, start, last = max(ends, key=lambda end: end[2])
    later = range(last, 20 * last + 1, max(1, last // 20))
    contact = next((n for n in later if _touches(model, start, n)), None)
    expected = "" if contact is None else f", expected at about {contact * model.dt:.2g} s,"
    raise InputError(
        "frames",
        f"the body touches nothing until the last frame, at {last * model.dt:.3g} s. The frame of first contact"
        f"{expected} is missing, and free flight does not depend on the material",
        "Use a longer video, or launch the body faster or closer to the floor",
    )


def _touches(model: MPM, start: State, n: int) -> bool:
    """Whether the body of an initial state would have a particle in the contact zone of a wall at step n."""
    mass, gravity = start.mass / start.mass.sum(), torch.tensor(model.gravity).to(start.x)
    centre, velocity = mass @ start.x, mass @ start.v.expand_as(start.x)
    turn = torch.linalg.matrix_exp(n * model.dt * (start.C[0] - start.C[0].mT) / 2)
    x = (
        centre
        + (start.x - centre) @ turn.mT
        + n * model.dt * velocity
        + model.dt**2 * n * (n + 1) / 2 * gravity
    )
    return float(contact_clearance(model, x, start.vol0, (n,))) <= 0


def held_out_frames(count: int, share: float, blocks: int = 1, contact: int = 0) -> list[int]:
    """Indices of the held-out frames: the last ones, at least one, of each of several equal blocks of the video.

    Args:
        count: number of frames of the video.
        share: share of the frames after the contact.
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
