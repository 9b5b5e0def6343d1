"""Reference rasterizer in plain torch with autograd, slow, to test the kernels."""

from collections.abc import Sequence

import torch

from neuma_lib.splatting import spherical_harmonics as harmonics
from neuma_lib.splatting.projection import NEAR_PLANE
from neuma_lib.splatting.rasterizer import check_shapes


def project(means, covars, viewmat, K, width, height, eps2d):
    """EWA projection of one frame to one camera.

    Args:
        means (G, 3), covars (G, 3, 3), viewmat (4, 4), K (3, 3).

    Returns:
        means2d (G, 2) [px], conics (G, 2, 2) [1/px^2], depths (G,) [m], visible (G,)
    """
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    points = means @ rotation.T + translation
    depths = points[:, 2]
    visible = depths >= NEAR_PLANE
    z = torch.where(visible, depths, torch.ones_like(depths))
    tangents = points[:, :2] / z[:, None]
    focal = torch.stack([K[0, 0], K[1, 1]])
    centre = torch.stack([K[0, 2], K[1, 2]])
    size = torch.tensor([width, height], dtype=means.dtype, device=means.device)
    margin = 0.3 * 0.5 * size / focal
    limited = torch.minimum(
        torch.maximum(tangents, -(centre / focal + margin)), (size - centre) / focal + margin
    )
    zeros = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([focal[0] / z, zeros, -focal[0] * limited[:, 0] / z], dim=-1),
            torch.stack([zeros, focal[1] / z, -focal[1] * limited[:, 1] / z], dim=-1),
        ],
        dim=-2,
    )
    m = jacobian @ rotation
    covars = (covars + covars.mT) / 2
    covars2d = m @ covars @ m.mT + eps2d * torch.eye(2, dtype=means.dtype, device=means.device)
    visible = visible & (torch.linalg.det(covars2d) > 0)
    identity = torch.eye(2, dtype=means.dtype, device=means.device)
    conics = torch.linalg.inv(torch.where(visible[:, None, None], covars2d, identity))
    return tangents * focal + centre, conics, depths, visible


def rasterize(
    means: torch.Tensor,
    covars: torch.Tensor,
    opacities: torch.Tensor,
    sh: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    *,
    background: Sequence[float] | torch.Tensor = (1.0, 1.0, 1.0),
    alpha_min: float = 1.0 / 255.0,
    alpha_max: float = 0.99,
    transmittance_min: float = 1e-4,
    eps2d: float = 0.3,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Same arguments and results as ``rasterizer.rasterize``; memory is proportional to G H W per image."""
    check_shapes(means, covars, opacities, sh, viewmats, Ks)
    background = torch.as_tensor(background, dtype=means.dtype, device=means.device)
    x = torch.arange(width, dtype=means.dtype, device=means.device) + 0.5
    y = torch.arange(height, dtype=means.dtype, device=means.device) + 0.5
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)  # (H, W, 2)
    images, alphas = [], []
    for t in range(means.shape[0]):
        for viewmat, K in zip(viewmats, Ks, strict=True):
            means2d, conics, depths, visible = project(means[t], covars[t], viewmat, K, width, height, eps2d)
            directions = torch.nn.functional.normalize(means[t] + viewmat[:3, :3].T @ viewmat[:3, 3], dim=-1)
            rgb = harmonics.colours(sh, directions)
            order = torch.argsort(depths, stable=True)
            order = order[(visible & (opacities > 0))[order]]
            image = torch.zeros(height, width, 3, dtype=means.dtype, device=means.device)
            transmittance = torch.ones(height, width, dtype=means.dtype, device=means.device)
            active = torch.ones(height, width, dtype=torch.bool, device=means.device)
            for g in order.tolist():
                offset = pixels - means2d[g]
                sigma = 0.5 * torch.einsum("hwi,ij,hwj->hw", offset, conics[g], offset)
                alpha = (opacities[g] * torch.exp(-sigma)).clamp_max(alpha_max)
                drawn = active & (alpha >= alpha_min) & (sigma >= 0)
                after = transmittance * (1 - alpha)
                opaque = drawn & (after < transmittance_min)
                active = active & ~opaque
                alpha = torch.where(drawn & ~opaque, alpha, torch.zeros_like(alpha))
                image = image + (alpha * transmittance)[..., None] * rgb[g]
                transmittance = transmittance * (1 - alpha)
            images.append(image + transmittance[..., None] * background)
            alphas.append(1 - transmittance)
    T, V = means.shape[0], viewmats.shape[0]
    return torch.stack(images).view(T, V, height, width, 3), torch.stack(alphas).view(T, V, height, width)
