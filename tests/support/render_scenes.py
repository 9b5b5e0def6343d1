"""Random Gaussian scenes, and bindings as dense matrices."""

import torch

from neuma_lib.splatting.cameras import look_at
from neuma_lib.splatting.gaussians import covariances


def random_scene(frames, count, views, width, height, coefficients, scale=0.03, dtype=torch.float64, seed=0):
    """means, covars, opacities, sh, viewmats, Ks of a cloud of ``count`` Gaussians about the origin."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    means = 0.5 * (uniform(count, 3) - 0.5) + 0.02 * (uniform(frames, count, 3) - 0.5)
    covars = covariances(uniform(frames, count, 4) - 0.5, scale * (0.3 + uniform(frames, count, 3)))
    opacities = 0.1 + 0.85 * uniform(count)
    sh = 0.6 * (uniform(count, coefficients, 3) - 0.5)
    eyes = 1.2 * torch.nn.functional.normalize(uniform(views, 3) - 0.5, dim=-1)
    viewmats = look_at(
        eyes, torch.zeros(3, dtype=torch.float64), torch.tensor([0.1, 1.0, 0.2], dtype=torch.float64)
    )
    K = torch.tensor([[1.6 * width, 0, 0.52 * width], [0, 1.5 * width, 0.48 * height], [0, 0, 1]])
    Ks = K.double().expand(views, 3, 3).contiguous()
    return [tensor.to(dtype) for tensor in (means, covars, opacities, sh, viewmats, Ks)]


def dense(binding):
    """The matrix B, shape (G, N)."""
    matrix = torch.zeros(binding.shape, dtype=binding.values.dtype, device=binding.values.device)
    matrix[torch.repeat_interleave(binding.counts), binding.indices] = binding.values
    return matrix
