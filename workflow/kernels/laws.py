"""Kernels of the neural and the structured laws, and of all laws without the simulator."""

from typing import get_args

import torch

from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import AdjointPrecision
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.mechanics.singular_values import svd3
from neuma_lib.mechanics.structured import structured_law
from workflow.kernels.simulation import SPEC, simulate


def compile_kernels(device: torch.device) -> None:
    """Rollouts with the gradients of what is trained, and stresses and return maps.

    Exports, priors and comparisons of stresses evaluate laws in double precision. What only some settings need, such as
    the structured energy, is compiled by the first job that uses it.
    """
    analytic, structured = analytic_law(SPEC), structured_law({**SPEC, "form": "stretch"})
    for precision in get_args(AdjointPrecision) if device.type == "cuda" else ("single",):
        neural = neural_law()
        neural.set_adjoint_precision(precision)
        simulate(neural, device, gradient=True)
    simulate(structured, device, gradient=True)
    for dtype in (torch.float32, torch.float64):
        F = torch.eye(3, dtype=dtype, device=device)[None]
        svd3(F)
        for law in (neural, structured, analytic):
            law.to(device, dtype)
            for part in (law.elasticity, law.plasticity):
                part.evaluate(F, tuple(w.detach() for w in part.weights()))
