"""Kernels of the neural, the structured and the analytic laws."""

from __future__ import annotations

from typing import get_args

import torch

from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import AdjointPrecision, Law
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.mechanics.structured import FORMS, structured_law

SPEC = {
    "elasticity": {"name": "hencky", "E": 1e4, "nu": 0.2},
    "plasticity": {"name": "von_mises", "yield_stress": 1e2},
}


def compile_kernels(device: torch.device) -> None:
    """All laws, forward and backward, in both precisions of states and of adjoints. Analytic laws share kernels."""
    laws: list[Law] = [neural_law(), *(structured_law({**SPEC, "form": form}) for form in FORMS)]
    laws.append(analytic_law(SPEC))
    for dtype in (torch.float32, torch.float64):
        for law in laws:
            law.to(device, dtype)
            F = torch.eye(3, dtype=dtype, device=device).repeat(4, 1, 1)
            for part in (law.elasticity, law.plasticity):
                weights = tuple(w.detach() for w in part.weights())
                value = part.evaluate(F, weights)
                for part.adjoint_precision in get_args(AdjointPrecision):
                    part.vjp(F, weights, torch.ones_like(value))
