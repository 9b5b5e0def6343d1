"""Kernels of the rasterizer."""

from __future__ import annotations

import torch

from neuma_lib.render.cameras import Cameras, look_at
from neuma_lib.render.rasterizer import rasterize


def compile_kernels(device: torch.device) -> None:
    """One small image, forward and backward, in both precisions."""
    for dtype in (torch.float32, torch.float64):
        generator = torch.Generator().manual_seed(0)
        means = (0.4 + 0.2 * torch.rand(1, 4, 3, generator=generator)).to(device, dtype).requires_grad_()
        covars = (0.05**2 * torch.eye(3, dtype=dtype, device=device)).repeat(1, 4, 1, 1)
        opacities = torch.full((4,), 0.5, dtype=dtype, device=device)
        sh = torch.zeros(4, 4, 3, dtype=dtype, device=device)
        K = torch.tensor([[[16.0, 0.0, 8.0], [0.0, 16.0, 8.0], [0.0, 0.0, 1.0]]])
        viewmats = look_at(
            torch.tensor([[0.5, 0.5, 2.0]]), torch.full((3,), 0.5), torch.tensor([0.0, 1.0, 0.0])
        )
        camera = Cameras(viewmats, K, 16, 16).to(device, dtype)
        images, _ = rasterize(means, covars, opacities, sh, camera.viewmats, camera.Ks, 16, 16)
        images.sum().backward()
