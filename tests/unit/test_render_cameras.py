"""Camera conventions: OpenCV and OpenGL poses, intrinsics of transforms.json, pixel centres."""

import json

import pytest
import torch

from neuma_lib.errors import InputError
from neuma_lib.splatting.cameras import Cameras, look_at
from neuma_lib.splatting.rasterizer import rasterize


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
    c2w = torch.eye(4, dtype=torch.float64)[None]
    c2w[0, 2, 3] = 3.0
    K = torch.tensor([[[50.0, 0, 20], [0, 50, 15], [0, 0, 1]]], dtype=torch.float64)
    cameras = Cameras.from_opengl(c2w, K, 40, 30)
    pixels, depths = cameras.project(torch.tensor([[0.3, 0.6, 0.0]], dtype=torch.float64))
    assert torch.allclose(pixels[0, 0], torch.tensor([25.0, 5.0]).double())  # right of and above the centre
    assert torch.allclose(depths, torch.tensor([[3.0]]).double())
    assert torch.allclose(cameras.to_opengl(), c2w)


def test_transforms_round_trip_through_json():
    cameras, _ = ring()
    text = json.dumps({"frames": cameras.to_transforms()})
    again = Cameras.from_transforms(json.loads(text), dtype=torch.float64)
    assert (again.viewmats - cameras.viewmats).abs().max() < 1e-14
    assert torch.equal(again.Ks, cameras.Ks) and (again.width, again.height) == (40, 30)


def test_transforms_field_of_view():
    frame = {"file_path": "a.png", "transform_matrix": torch.eye(4).tolist(), "w": 100, "h": 80}
    cameras = Cameras.from_transforms(
        {"camera_angle_x": 2 * torch.atan(torch.tensor(0.5)).item(), "frames": [frame]}
    )
    assert torch.allclose(cameras.Ks[0], torch.tensor([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]]))


@pytest.mark.parametrize("missing", ["w", "transform_matrix", "fl_x"])
def test_transforms_errors_name_the_frame(missing):
    frame = {"file_path": "a.png", **ring(1)[0].to_transforms()[0]}
    del frame[missing]
    with pytest.raises(InputError, match="a.png"):
        Cameras.from_transforms({"frames": [frame]})


def test_rendered_centroid_is_the_projected_point():
    """A small Gaussian's light lies where ``project`` says, with pixel centres at half integers."""
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
