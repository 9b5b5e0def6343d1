"""Camera conventions: OpenCV and OpenGL poses, pixel centres."""

import numpy as np
import pytest
import torch

from neuma_lib.splatting.cameras import Cameras, look_at
from neuma_lib.splatting.rasterizer import rasterize
from neuma_lib.splatting.viewpoints import Views

pytestmark = pytest.mark.core


def ring(count=4, width=40, height=30):
    angles = torch.linspace(0.3, 5.0, count, dtype=torch.float64)
    eyes = torch.stack([2 * torch.sin(angles), 0.3 + 0.1 * angles, 2 * torch.cos(angles)], dim=-1)
    viewmats = look_at(eyes, torch.tensor([0.1, 0.2, 0.0]).double(), torch.tensor([0.0, 1.0, 0.0]).double())
    K = torch.tensor([[50.0, 0, 19.0], [0, 52.0, 16.0], [0, 0, 1]], dtype=torch.float64)
    return Cameras(viewmats, K.expand(count, 3, 3).clone(), width, height), eyes


def test_positions_and_up():
    cameras, eyes = ring()
    assert (cameras.positions - eyes).abs().max() < 1e-12
    target, above = torch.tensor([[0.1, 0.2, 0.0], [0.1, 0.3, 0.0]]).double()
    pixels, depths = cameras.project(torch.stack([target, above]))
    assert (pixels[:, 0] - torch.tensor([19.0, 16.0]).double()).abs().max() < 1e-6
    assert (depths > 0).all()
    assert (pixels[:, 1, 1] < pixels[:, 0, 1]).all()  # rows run downwards


def test_opengl_camera_looks_along_minus_z():
    c2w = np.eye(4)[None]
    c2w[0, 2, 3] = 3.0
    views = Views(c2w, focal=50.0, width=40, height=30)
    cameras = Cameras(torch.from_numpy(views.viewmats), torch.from_numpy(views.K)[None], 40, 30)
    pixels, depths = cameras.project(torch.tensor([[0.3, 0.6, 0.0]], dtype=torch.float64))
    assert torch.allclose(pixels[0, 0], torch.tensor([25.0, 5.0]).double())  # right of and above the centre
    assert torch.allclose(depths, torch.tensor([[3.0]]).double())


def test_rendered_centroid_is_the_projected_point():
    """The centroid of a small Gaussian is the result of ``project``, with pixel centres at half integers."""
    cameras, _ = ring()
    point = torch.tensor([[0.25, 0.1, -0.15]], dtype=torch.float64)
    _, alphas = rasterize(
        point[None],
        (1e-8 * torch.eye(3, dtype=torch.float64))[None, None],
        torch.tensor([0.9], dtype=torch.float64),
        torch.zeros(1, 1, 3, dtype=torch.float64),
        cameras.viewmats,
        cameras.Ks,
        cameras.width,
        cameras.height,
        alpha_min=0.0,
        eps2d=2.0,
    )
    weights = alphas[0] / alphas[0].sum(dim=(1, 2), keepdim=True)
    x = (weights * (torch.arange(40) + 0.5)).sum(dim=(1, 2))
    y = (weights * (torch.arange(30)[:, None] + 0.5)).sum(dim=(1, 2))
    pixels, _ = cameras.project(point)
    assert (torch.stack([x, y], dim=-1) - pixels[:, 0]).abs().max() < 2e-3
