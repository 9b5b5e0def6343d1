"""Kernels of the neural laws."""

from __future__ import annotations

import torch

from neuma_lib.mechanics.neural import neural_law


def compile_kernels(device: torch.device) -> None:
    """Both networks, forward and backward, in both precisions."""
    for dtype in (torch.float32, torch.float64):
        law = neural_law().to(device, dtype)
        F = torch.eye(3, dtype=dtype, device=device).repeat(4, 1, 1)
        for part in (law.elasticity, law.plasticity):
            weights = tuple(w.detach() for w in part.weights())
            value = part.evaluate(F, weights)
            part.vjp(F, weights, torch.ones_like(value))
