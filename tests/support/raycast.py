"""Ground-truth pictures without Blender: a textured body of smooth-joined spheres, sphere-traced in torch."""

import torch

from neuma_lib.splatting.cameras import Cameras, look_at

CENTRE = torch.tensor([0.5, 0.4, 0.5])


def distance(points):
    """Signed distance (a lower bound of it) of a duck-like body about CENTRE, about 0.4 m long."""
    p = points - CENTRE
    parts = [
        ((p - torch.tensor([0.0, -0.03, 0.0])) / torch.tensor([1.4, 0.9, 1.0])).norm(dim=-1) * 0.9 - 0.1,
        (p - torch.tensor([0.09, 0.1, 0.0])).norm(dim=-1) - 0.075,
        ((p - torch.tensor([0.18, 0.09, 0.0])) / torch.tensor([1.5, 0.6, 1.0])).norm(dim=-1) * 0.6 - 0.018,
    ]
    k = 0.02
    return -k * torch.logsumexp(torch.stack([-part / k for part in parts]), dim=0)


def colour(points):
    """Procedural texture: waves of two scales over a base that changes with position."""
    p = (points - CENTRE) * 40
    x, y, z = p.unbind(-1)
    wave = torch.sin(x + 2 * torch.sin(0.5 * y)) * torch.sin(y + z)
    fine = torch.sin(2.3 * x + 1.1 * z) * torch.sin(2.1 * y)
    base = torch.tensor([0.75, 0.55, 0.2]) + 0.15 * torch.stack([x, y, z], dim=-1) / 8
    return (base + 0.2 * wave[..., None] + 0.15 * fine[..., None] * torch.tensor([1.0, 0.5, -1.0])).clamp(
        0, 1
    )


def sphere_cameras(count, size, radius=1.0):
    """``count`` cameras evenly on a sphere around CENTRE; the body fills about half the width."""
    i = torch.arange(count) + 0.5
    height = 1 - 2 * i / count
    angle = i * (torch.pi * (5**0.5 - 1))
    ring = (1 - height**2).sqrt()
    eyes = CENTRE + radius * torch.stack([ring * torch.cos(angle), height, ring * torch.sin(angle)], dim=-1)
    viewmats = look_at(eyes, CENTRE, torch.tensor([0.0, 1.0, 0.0]))
    K = torch.tensor([[1.8 * size, 0, size / 2], [0, 1.8 * size, size / 2], [0, 0, 1]])
    return Cameras(viewmats, K.expand(count, 3, 3).clone(), size, size)


def render(cameras, samples=3):
    """(V, H, W, 4) RGBA with straight alpha, ``samples``^2 rays a pixel, one light and ambient."""
    offsets = (torch.arange(samples) + 0.5) / samples
    rows = (torch.arange(cameras.height)[:, None] + offsets).reshape(-1)
    columns = (torch.arange(cameras.width)[:, None] + offsets).reshape(-1)
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    light = torch.nn.functional.normalize(torch.tensor([0.4, 1.0, 0.5]), dim=0)
    pictures = []
    for viewmat, K, eye in zip(cameras.viewmats, cameras.Ks, cameras.positions, strict=True):
        local = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], dim=-1)
        rays = torch.nn.functional.normalize(local @ viewmat[:3, :3], dim=-1).reshape(-1, 3)
        # only rays that meet the bounding sphere are traced
        along = rays @ (CENTRE - eye)
        near = ((eye + along[:, None] * rays - CENTRE).norm(dim=-1) < 0.28).nonzero()[:, 0]
        d, t = rays[near], along[near] - 0.28
        for _ in range(64):
            t = t + distance(eye + t[:, None] * d)
        p = eye + t[:, None] * d
        hit = (distance(p) < 1e-3) & (t < along[near] + 0.28)
        p = p[hit].requires_grad_()
        normals = torch.nn.functional.normalize(torch.autograd.grad(distance(p).sum(), p)[0], dim=-1)
        p = p.detach()
        rgba = torch.zeros(len(rays), 4)
        shade = 0.45 + 0.55 * (normals @ light).clamp_min(0)
        rgba[near[hit]] = torch.cat([colour(p) * shade[:, None], torch.ones(len(p), 1)], dim=-1)
        rgba = rgba.reshape(cameras.height, samples, cameras.width, samples, 4).mean(dim=(1, 3))
        rgba[..., :3] /= rgba[..., 3:].clamp_min(1e-6)
        pictures.append(rgba)
    return torch.stack(pictures)
