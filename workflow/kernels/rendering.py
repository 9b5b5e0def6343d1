"""Kernels from particles to the image loss."""

from __future__ import annotations

import torch

from neuma_lib.coupling.deformation import deform
from neuma_lib.fitting.image_loss import mean_squared_error
from neuma_lib.splatting.cameras import Cameras, look_at
from neuma_lib.splatting.rasterizer import rasterize


class _OneEach:
    """Binds four Gaussians to a particle each. A binding of its own, so that an edit of how bindings are made spares
    the compiled kernels and all that waits for them.
    """

    shape = (4, 4)

    def __init__(self, device: torch.device):
        self._arrays = [torch.arange(n, dtype=torch.int32, device=device) for n in (5, 4)]

    def apply(self, field: torch.Tensor) -> torch.Tensor:
        return field

    def rows(self, dtype: torch.dtype) -> tuple[torch.Tensor, ...]:
        return *self._arrays, torch.ones(4, dtype=dtype, device=self._arrays[0].device)

    columns = rows


def compile_kernels(device: torch.device) -> None:
    """The loss of one small image, forward and backward, in both precisions."""
    for dtype in (torch.float32, torch.float64):
        generator = torch.Generator().manual_seed(0)
        x0 = (0.4 + 0.2 * torch.rand(4, 3, generator=generator)).to(device, dtype)
        covars = (0.05**2 * torch.eye(3, dtype=dtype, device=device)).repeat(4, 1, 1)
        F = torch.eye(3, dtype=dtype, device=device).repeat(1, 4, 1, 1).requires_grad_()
        moved = deform(x0, covars, _OneEach(device), x0, x0[None].clone().requires_grad_(), F)
        opacities = torch.full((4,), 0.5, dtype=dtype, device=device)
        sh = torch.zeros(4, 4, 3, dtype=dtype, device=device).requires_grad_()
        K = torch.tensor([[[16.0, 0.0, 8.0], [0.0, 16.0, 8.0], [0.0, 0.0, 1.0]]])
        viewmats = look_at(
            torch.tensor([[0.5, 0.5, 2.0]]), torch.full((3,), 0.5), torch.tensor([0.0, 1.0, 0.0])
        )
        camera = Cameras(viewmats, K, 16, 16).to(device, dtype)
        images, _ = rasterize(*moved, opacities, sh, camera.viewmats, camera.Ks, 16, 16)
        observed = torch.zeros(1, 1, 16, 16, 4, dtype=torch.uint8, device=device)
        mean_squared_error(images, observed).sum().backward()
