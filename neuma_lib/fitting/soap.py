"""SOAP: Adam in the eigenbasis of Shampoo's preconditioner (Vyas et al. 2024), for small matrices.

The regression of priors is ill-conditioned for Adam. In equal time SOAP reaches a five to ten times lower loss.
"""

from collections.abc import Iterable

import torch
from torch import Tensor


class SOAP(torch.optim.Optimizer):
    """Adam on gradients rotated into the eigenvectors of E[G G^T] and E[G^T G].

    Args:
        params: matrices (m, n).
        lr: step size, as in Adam.
        decay: decay of the running means of the gradient, its square and the two second moments.
        every: steps between updates of the eigenvectors by one orthogonal iteration.
    """

    def __init__(self, params: Iterable[Tensor], lr: float = 2e-2, decay: float = 0.95, every: int = 10):
        super().__init__(params, {"lr": lr, "decay": decay, "every": every})

    @torch.no_grad()
    def step(self, closure=None):
        for group in self.param_groups:
            for p in group["params"]:
                if p.grad is not None:
                    self._step(p, p.grad, self.state[p], group["lr"], group["decay"], group["every"])

    @staticmethod
    def _step(p: Tensor, G: Tensor, state: dict, lr: float, decay: float, every: int) -> None:
        if not state:
            state["L"], state["R"] = G @ G.mT, G.mT @ G
            state["QL"], state["QR"] = (torch.linalg.eigh(state[side])[1] for side in ("L", "R"))
            state["mean"], state["square"], state["step"] = torch.zeros_like(G), torch.zeros_like(G), 0
        QL, QR = state["QL"], state["QR"]
        state["step"] += 1
        state["mean"].lerp_(G, 1 - decay)
        state["square"].lerp_((QL.mT @ G @ QR).square(), 1 - decay)
        correction = 1 - decay ** state["step"]
        direction = (QL.mT @ state["mean"] @ QR) / correction
        direction /= (state["square"] / correction).sqrt() + 1e-8
        p.sub_(QL @ direction @ QR.mT, alpha=lr)
        state["L"].lerp_(G @ G.mT, 1 - decay)
        state["R"].lerp_(G.mT @ G, 1 - decay)
        if state["step"] % every == 0:
            state["QL"] = torch.linalg.qr(state["L"] @ QL)[0]
            state["QR"] = torch.linalg.qr(state["R"] @ QR)[0]
