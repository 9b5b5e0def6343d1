"""Division of Gaussians into bodies by labelled images, and the bodies behind others."""

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.rasterizer import rasterize
from neuma_lib.splatting.spherical_harmonics import SH_C0

MIN_WEIGHT = 0.1
"""Least weight [px] with which a Gaussian must be visible in all images together to be assigned by them."""


_MIN_ALPHA = 1e-6  # keeps colours of empty pixels finite


def bodies_of(gaussians: Gaussians, cameras: Cameras, labels: Tensor, count: int) -> Tensor:
    """Body of each Gaussian, shape (G,), from 0.

    A Gaussian belongs to the body in whose pixels it has the largest weight: its share of their colours, summed over
    the pixels of all images. That is the derivative of the colours by its own. Gaussians that no image shows, inside a
    body or hidden, belong to the body of the nearest one that is visible.

    Args:
        cameras: V cameras.
        labels: number of the visible body in each pixel, from 1, or 0 for none, shape (V, H, W).

    Raises:
        InputError: the labels have another shape, or no Gaussian is visible in the pixels of a body.
    """
    if tuple(labels.shape) != (len(cameras), cameras.height, cameras.width) or labels.max() > count:
        problem = f"shape {tuple(labels.shape)} with labels up to {int(labels.max())} does not match"
        expected = f"{len(cameras)} images of {cameras.height} x {cameras.width} px with {count} bodies"
        raise InputError("labels", f"{problem} {expected}")
    weights = []
    for first in range(1, count + 1, 3):  # a body for each channel of colour
        colors = torch.zeros_like(gaussians.sh0).requires_grad_()
        total = gaussians.means.new_zeros(())
        masks = torch.stack([labels == first + k for k in range(3)], dim=-1).to(gaussians.means)
        for view in range(len(cameras)):
            camera = cameras[view]
            pictures, _ = rasterize(
                gaussians.means[None], gaussians.covars()[None], gaussians.opacities, colors, camera.viewmats,
                camera.Ks, camera.width, camera.height, eps2d=0.0,
            )  # fmt: skip
            total = total + (pictures[0, 0] * masks[view]).sum()
        (gradient,) = torch.autograd.grad(total, colors)
        weights.append(gradient[:, 0])
    share = torch.cat(weights, dim=1)[:, :count] / SH_C0
    seen = share.sum(dim=1) > MIN_WEIGHT
    body = share.argmax(dim=1)
    missing = [k + 1 for k in range(count) if not (body[seen] == k).any()]
    if missing:
        problem = f"no Gaussian is visible as body {missing[0]}"
        raise InputError("labels", problem, "Check the labels of the images")
    points = gaussians.means.detach().cpu().double().numpy()
    visible = seen.cpu().numpy()
    nearest = torch.from_numpy(cKDTree(points[visible]).query(points[~visible])[1]).to(body)
    return body.index_put((~seen,), body[seen][nearest])


def without_others(gaussians: Gaussians, cameras: Cameras, images: Tensor, hidden: Tensor) -> Tensor:
    """Images of a body, completed where others hide it by renders of its Gaussians, shape (V, H, W, 4).

    Args:
        cameras: V cameras.
        images: straight-alpha RGBA in [0, 1] of its visible part, shape (V, H, W, 4).
        hidden: pixels that show another body, shape (V, H, W).
    """
    with torch.no_grad():
        colours, alpha = rasterize(
            gaussians.means[None], gaussians.covars()[None], gaussians.opacities, gaussians.sh(), cameras.viewmats,
            cameras.Ks, cameras.width, cameras.height, background=(0, 0, 0), eps2d=0.0,
        )  # fmt: skip
    coverage = alpha[0, ..., None]
    rendered = torch.cat([colours[0] / coverage.clamp_min(_MIN_ALPHA), coverage], dim=-1)
    return torch.where(hidden[..., None], rendered.clamp(0, 1), images)
