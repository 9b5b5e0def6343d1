"""Random Gaussian scenes, checks of renderers, and bindings as dense matrices."""

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


SMOOTH = dict(alpha_min=0.0, alpha_max=2.0, transmittance_min=0.0)
LOOSE = dict(alpha_min=1 / 255, alpha_max=0.6, transmittance_min=0.05)
BACKGROUND = (0.2, 0.5, 0.9)


def with_gradients(render, scene, width, height, **options):
    """Images and alphas, and gradients of a random linear function of them."""
    inputs = [tensor.clone().requires_grad_() for tensor in scene[:4]]
    outputs = render(*inputs, *scene[4:], width, height, background=BACKGROUND, **options)
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(out.shape, generator=generator, dtype=torch.float64) for out in outputs]
    loss = sum((weight.to(out) * out).sum() for weight, out in zip(weights, outputs, strict=True))
    return [out.detach() for out in outputs], torch.autograd.grad(loss, inputs)


def assert_each_image_is_rendered_alone(render, scene, width, height):
    """Frames and views of a batch are the same bytes as in single calls."""
    means, covars, opacities, sh, viewmats, Ks = scene
    images, alphas = render(*scene, width, height)
    for t in range(len(means)):
        for v in range(len(viewmats)):
            one = (means[t][None], covars[t][None], opacities, sh, viewmats[v][None], Ks[v][None])
            image, alpha = render(*one, width, height)
            assert torch.equal(images[t, v], image[0, 0]) and torch.equal(alphas[t, v], alpha[0, 0])


def assert_slope(function, point, direction):
    """Gradient of a smooth function along a direction, against a central difference of fourth order."""
    leaf = point.clone().requires_grad_()
    exact = (torch.autograd.grad(function(leaf), leaf)[0] * direction).sum()
    h = 1e-5
    near, far = (function(point + k * h * direction) - function(point - k * h * direction) for k in (1, 2))
    difference = (8 * near - far) / (12 * h)
    assert abs(exact - difference) < 1e-6 * abs(exact) + 1e-8


def dense(binding):
    """The matrix B, shape (G, N)."""
    matrix = torch.zeros(binding.shape, dtype=binding.values.dtype, device=binding.values.device)
    matrix[torch.repeat_interleave(binding.counts), binding.indices] = binding.values
    return matrix
