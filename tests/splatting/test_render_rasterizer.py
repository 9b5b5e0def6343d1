"""The fast rasterizer against its torch twin, finite differences and closed forms."""

import math

import pytest
import torch

from neuma_lib.splatting import torch_reference
from neuma_lib.splatting.rasterizer import RenderBuffers, Statistics, rasterize
from tests.support.errors import refused
from tests.support.render_scenes import random_scene

pytestmark = pytest.mark.core

SMOOTH = dict(alpha_min=0.0, alpha_max=2.0, transmittance_min=0.0)
LOOSE = dict(alpha_min=1 / 255, alpha_max=0.6, transmittance_min=0.05)
WIDTH, HEIGHT = 26, 21


def render_with_gradients(render, scene, seed=1, **options):
    """Images, alphas and the gradients of a random linear function of them."""
    inputs = [tensor.clone().requires_grad_() for tensor in scene[:4]]
    images, alphas = render(*inputs, *scene[4:], WIDTH, HEIGHT, background=(0.2, 0.5, 0.9), **options)
    generator = torch.Generator().manual_seed(seed)
    weights = [torch.randn(out.shape, generator=generator, dtype=out.dtype) for out in (images, alphas)]
    loss = sum((weight * out).sum() for weight, out in zip(weights, (images, alphas), strict=True))
    return (images.detach(), alphas.detach()), torch.autograd.grad(loss, inputs)


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("options", [{}, SMOOTH, LOOSE], ids=["default", "smooth", "loose"])
def test_equals_twin(options, coefficients):
    # two frames and two views; wide Gaussians, so that pixels end early and alphas are clamped; some sh give
    # colours below zero
    scene = random_scene(2, 50, 2, WIDTH, HEIGHT, coefficients, scale=0.06)
    scene[3] = scene[3] * 3
    expected, expected_grads = render_with_gradients(torch_reference.rasterize, scene, **options)
    actual, grads = render_with_gradients(rasterize, scene, **options)
    for a, b in zip(expected, actual, strict=True):
        assert (a - b).abs().max() < 1e-9
    for a, b in zip(expected_grads, grads, strict=True):
        assert (a - b).abs().max() < 1e-9 * max(1.0, float(a.abs().max()))


def test_equals_twin_close_to_the_camera():
    # Gaussians behind the camera, at the near plane and far outside the image, where the tangents are limited
    scene = random_scene(1, 60, 1, WIDTH, HEIGHT, 4, scale=0.05)
    scene[0] = scene[0] * 6
    expected, expected_grads = render_with_gradients(torch_reference.rasterize, scene)
    actual, grads = render_with_gradients(rasterize, scene)
    for a, b in zip(expected, actual, strict=True):
        assert (a - b).abs().max() < 1e-9
    for a, b in zip(expected_grads, grads, strict=True):
        assert (a - b).abs().max() < 1e-9 * max(1.0, float(a.abs().max()))


def test_float32_agrees_with_float64():
    scene = random_scene(2, 600, 2, 64, 64, 9, scale=0.02)
    precise = rasterize(*scene, 64, 64)[0]
    single = rasterize(*(tensor.float() for tensor in scene), 64, 64)[0]
    error = (single.double() - precise).abs()
    assert error.mean() < 1e-5
    assert (error.amax(dim=-1) > 1 / 255).double().mean() <= 1e-3


def test_float32_gradients_agree_with_float64():
    scene = random_scene(1, 200, 1, WIDTH, HEIGHT, 4, scale=0.03)
    _, precise = render_with_gradients(rasterize, scene, **SMOOTH)
    inputs = [tensor.float().requires_grad_() for tensor in scene[:4]]
    images, alphas = rasterize(
        *inputs, *(t.float() for t in scene[4:]), WIDTH, HEIGHT, background=(0.2, 0.5, 0.9), **SMOOTH
    )
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(out.shape, generator=generator, dtype=torch.float64) for out in (images, alphas)]
    loss = sum((weight.float() * out).sum() for weight, out in zip(weights, (images, alphas), strict=True))
    for a, b in zip(precise, torch.autograd.grad(loss, inputs), strict=True):
        assert (a - b.double()).norm() < 1e-3 * a.norm()


@pytest.mark.parametrize("argument", ["means", "covars", "opacities", "sh"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_gradient_along_random_directions(argument, seed):
    scene = random_scene(2, 30, 2, WIDTH, HEIGHT, 16, scale=0.04, seed=seed)
    index = ["means", "covars", "opacities", "sh"].index(argument)
    generator = torch.Generator().manual_seed(seed)
    direction = torch.randn(scene[index].shape, generator=generator, dtype=torch.float64)
    if argument == "covars":
        direction = direction * 1e-3  # of the size of the covariances themselves
    weights = torch.randn(2, 2, HEIGHT, WIDTH, 3, generator=generator, dtype=torch.float64)

    def loss(step, requires_grad=False):
        inputs = list(scene)
        inputs[index] = (scene[index] + step * direction).requires_grad_(requires_grad)
        images, alphas = rasterize(*inputs, WIDTH, HEIGHT, **SMOOTH)
        return (weights * images).sum() + (weights[..., 0] * alphas).sum(), inputs[index]

    value, leaf = loss(0.0, requires_grad=True)
    exact = (torch.autograd.grad(value, leaf)[0] * direction).sum()
    h = 1e-5
    difference = (8 * (loss(h)[0] - loss(-h)[0]) - (loss(2 * h)[0] - loss(-2 * h)[0])) / (12 * h)
    assert abs(exact - difference) < 1e-6 * abs(exact) + 1e-8


def test_single_gaussian_closed_form():
    """An isotropic Gaussian on the axis: alpha = o exp(-r^2 / 2 s^2) with s^2 = (f sigma / z)^2 + eps2d."""
    sigma, depth, focal, size, opacity = 0.05, 2.0, 80.0, 31, 0.7
    means = torch.tensor([[[0.0, 0.0, depth]]], dtype=torch.float64)
    covars = sigma**2 * torch.eye(3, dtype=torch.float64)[None, None]
    sh = torch.tensor([[[0.4, -0.3, 0.1]]], dtype=torch.float64)
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=torch.float64)[None]
    view = torch.eye(4, dtype=torch.float64)[None]
    images, alphas = rasterize(
        means,
        covars,
        torch.tensor([opacity], dtype=torch.float64),
        sh,
        view,
        K,
        size,
        size,
        background=(0, 0, 1.0),
    )
    centre = torch.arange(size, dtype=torch.float64) + 0.5 - size / 2
    r2 = centre[:, None] ** 2 + centre**2
    expected = opacity * torch.exp(-r2 / (2 * ((focal * sigma / depth) ** 2 + 0.3)))
    expected = torch.where(expected >= 1 / 255, expected, 0.0)
    assert (alphas[0, 0] - expected).abs().max() < 1e-12
    colour = 0.5 + sh[0, 0] * 0.5 / math.sqrt(math.pi)
    blue = torch.tensor([0, 0, 1.0], dtype=torch.float64)
    assert (
        images[0, 0] - (expected[..., None] * colour + (1 - expected[..., None]) * blue)
    ).abs().max() < 1e-12


def test_nearer_gaussian_hides_the_farther():
    means = torch.tensor([[[0.0, 0.0, 3.0], [0.0, 0.0, 2.0]]])
    covars = 0.1 * torch.eye(3).expand(1, 2, 3, 3).contiguous()
    sh = torch.zeros(2, 1, 3)
    sh[0, 0, 0], sh[1, 0, 1] = 1.5, 1.5
    K = torch.tensor([[[20.0, 0, 4.5], [0, 20.0, 4.5], [0, 0, 1]]])
    images, _ = rasterize(means, covars, torch.tensor([0.9, 0.9]), sh, torch.eye(4)[None], K, 9, 9)
    red, green, _ = images[0, 0, 4, 4]
    assert green > red


def test_frames_and_views_are_independent():
    scene = random_scene(3, 80, 2, WIDTH, HEIGHT, 4)
    means, covars, opacities, sh, viewmats, Ks = scene
    images, alphas = rasterize(*scene, WIDTH, HEIGHT)
    for t in range(3):
        for v in range(2):
            image, alpha = rasterize(
                means[t : t + 1],
                covars[t : t + 1],
                opacities,
                sh,
                viewmats[v : v + 1],
                Ks[v : v + 1],
                WIDTH,
                HEIGHT,
            )
            assert torch.equal(images[t, v], image[0, 0]) and torch.equal(alphas[t, v], alpha[0, 0])


def test_order_of_gaussians_does_not_matter():
    scene = random_scene(1, 80, 1, WIDTH, HEIGHT, 4)
    permutation = torch.randperm(80, generator=torch.Generator().manual_seed(0))
    shuffled = [
        scene[0][:, permutation],
        scene[1][:, permutation],
        scene[2][permutation],
        scene[3][permutation],
    ]
    assert torch.equal(
        rasterize(*scene, WIDTH, HEIGHT)[0], rasterize(*shuffled, *scene[4:], WIDTH, HEIGHT)[0]
    )


def test_kept_buffers_change_nothing():
    scene = random_scene(2, 80, 1, WIDTH, HEIGHT, 4)
    buffers = RenderBuffers()
    for _ in range(2):
        expected, expected_grads = render_with_gradients(rasterize, scene)
        actual, grads = render_with_gradients(rasterize, scene, buffers=buffers)
        assert all(torch.equal(a, b) for a, b in zip(expected + expected_grads, actual + grads, strict=True))


def test_two_renders_before_backward():
    scene = random_scene(2, 80, 1, WIDTH, HEIGHT, 4)
    means = scene[0].clone().requires_grad_()
    total = sum(
        rasterize(means[t : t + 1], scene[1][t : t + 1], *scene[2:], WIDTH, HEIGHT)[0].sum() for t in (0, 1)
    )
    together = rasterize(means, *scene[1:], WIDTH, HEIGHT)[0].sum()
    a, b = torch.autograd.grad(total, means)[0], torch.autograd.grad(together, means)[0]
    assert (a - b).abs().max() < 1e-12


def test_statistics_count_views():
    scene = random_scene(1, 40, 3, WIDTH, HEIGHT, 1)
    scene[2][0] = 1e-4  # too faint to be drawn
    statistics = Statistics()
    render_with_gradients(rasterize, scene, statistics=statistics)
    assert statistics.views[0] == 0 and statistics.screen_gradients[0] == 0
    assert statistics.views.max() == 3 and torch.isfinite(statistics.screen_gradients).all()


def test_empty_image_is_background():
    scene = random_scene(1, 10, 1, WIDTH, HEIGHT, 1)
    scene[0] = scene[0] + 100.0
    (images, alphas), grads = render_with_gradients(rasterize, scene)
    assert torch.equal(images, torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64).expand_as(images))
    assert alphas.abs().max() == 0
    assert all(grad.abs().max() == 0 for grad in grads)


def test_shape_errors_name_the_argument():
    scene = random_scene(1, 10, 1, WIDTH, HEIGHT, 1)
    with refused("rasterize: opacities"):
        rasterize(scene[0], scene[1], scene[2][:5], *scene[3:], WIDTH, HEIGHT)
    with refused("rasterize: sh"):
        rasterize(*scene[:3], scene[3].float(), *scene[4:], WIDTH, HEIGHT)
