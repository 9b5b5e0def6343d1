"""Kernels from particles to the image loss."""

import torch

from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.deformation import deform
from neuma_lib.splatting.rasterizer import rasterize, rasterized_error

SIZE = 16  # width and height of the image [px]
INTRINSICS = [[16.0, 0.0, 8.0], [0.0, 16.0, 8.0], [0.0, 0.0, 1.0]]


def compile_kernels(device: torch.device) -> None:
    """The loss of one small image of four Gaussians, forward and backward."""
    x0 = torch.tensor([[0.1, 0, 2], [0, 0.1, 2], [-0.1, 0, 2], [0, -0.1, 2]], device=device)
    eye = torch.eye(3, device=device).expand(4, 3, 3)
    x, F = x0[None].clone().requires_grad_(), eye[None].clone().requires_grad_()
    means, covars = deform(x0, 0.05**2 * eye, Binding.identity(4, x0), x0, x, F)
    opacities = torch.full((4,), 0.5, device=device)
    sh = torch.zeros(4, 4, 3, device=device, requires_grad=True)
    camera = torch.eye(4, device=device)[None], torch.tensor([INTRINSICS], device=device)
    scene = (means, covars, opacities, sh, *camera, SIZE, SIZE)
    observed = torch.zeros(1, 1, SIZE, SIZE, 4, dtype=torch.uint8, device=device)
    (rasterize(*scene)[0].sum() + rasterized_error(*scene, observed).sum()).backward()
