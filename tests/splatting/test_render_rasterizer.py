"""The fast rasterizer against its torch twin, finite differences and closed forms."""

import math

import pytest
import torch

from benchmarks import torch_rasterizer
from neuma_lib.splatting.rasterizer import RenderBuffers, Statistics, rasterize
from tests.support.errors import refused
from tests.support.render_scenes import (
    BACKGROUND,
    LOOSE,
    SMOOTH,
    assert_each_image_is_rendered_alone,
    assert_slope,
    random_scene,
    with_gradients,
)

pytestmark = pytest.mark.core

WIDTH, HEIGHT = 26, 21


def render_with_gradients(render, scene, **options):
    return with_gradients(render, scene, WIDTH, HEIGHT, **options)


def assert_equals_twin(scene, **options):
    expected, expected_grads = render_with_gradients(torch_rasterizer.rasterize, scene, **options)
    actual, grads = render_with_gradients(rasterize, scene, **options)
    for a, b in zip(expected, actual, strict=True):
        assert (a - b).abs().max() < 1e-9
    for a, b in zip(expected_grads, grads, strict=True):
        assert (a - b).abs().max() < 1e-9 * max(1.0, float(a.abs().max()))


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("options", [{}, SMOOTH, LOOSE], ids=["default", "smooth", "loose"])
def test_equals_twin(options, coefficients):
    # two frames and two views; wide Gaussians, so that pixels end early and alphas are clamped; some sh give
    # colours below zero
    scene = random_scene(2, 50, 2, WIDTH, HEIGHT, coefficients, scale=0.06)
    scene[3] = scene[3] * 3
    assert_equals_twin(scene, **options)


def test_equals_twin_close_to_the_camera():
    # Gaussians behind the camera, at the near plane and far outside the image, where the tangents are limited
    scene = random_scene(1, 60, 1, WIDTH, HEIGHT, 4, scale=0.05)
    scene[0] = scene[0] * 6
    assert_equals_twin(scene)


def test_equals_twin_with_many_splats():
    # more than a CPU lists at a time, by number and by tiles
    assert_equals_twin(random_scene(1, 600, 1, WIDTH, HEIGHT, 1, scale=0.03), **LOOSE)


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
    _, single = render_with_gradients(rasterize, [tensor.float() for tensor in scene], **SMOOTH)
    for a, b in zip(precise, single, strict=True):
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

    def loss(value):
        inputs = [*scene[:index], value, *scene[index + 1 :]]
        images, alphas = rasterize(*inputs, WIDTH, HEIGHT, **SMOOTH)
        return (weights * images).sum() + (weights[..., 0] * alphas).sum()

    assert_slope(loss, scene[index], direction)


def test_single_gaussian_closed_form():
    """An isotropic Gaussian on the axis: alpha = o exp(-r^2 / 2 s^2) with s^2 = (f sigma / z)^2 + eps2d."""
    sigma, depth, focal, size, opacity = 0.05, 2.0, 80.0, 31, 0.7
    means = torch.tensor([[[0.0, 0.0, depth]]], dtype=torch.float64)
    covars, view = sigma**2 * torch.eye(3).double()[None, None], torch.eye(4).double()[None]
    sh = torch.tensor([[[0.4, -0.3, 0.1]]], dtype=torch.float64)
    K = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]], dtype=torch.float64)[None]
    scene = (means, covars, torch.tensor([opacity], dtype=torch.float64), sh, view, K)
    images, alphas = rasterize(*scene, size, size, background=(0, 0, 1.0))
    centre = torch.arange(size, dtype=torch.float64) + 0.5 - size / 2
    r2 = centre[:, None] ** 2 + centre**2
    expected = opacity * torch.exp(-r2 / (2 * ((focal * sigma / depth) ** 2 + 0.3)))
    expected = torch.where(expected >= 1 / 255, expected, 0.0)
    assert (alphas[0, 0] - expected).abs().max() < 1e-12
    colour = 0.5 + sh[0, 0] * 0.5 / math.sqrt(math.pi)
    blue = torch.tensor([0, 0, 1.0], dtype=torch.float64)
    expected = expected[..., None] * colour + (1 - expected[..., None]) * blue
    assert (images[0, 0] - expected).abs().max() < 1e-12


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
    assert_each_image_is_rendered_alone(rasterize, scene, WIDTH, HEIGHT)


def test_order_of_gaussians_does_not_matter():
    scene = random_scene(1, 80, 1, WIDTH, HEIGHT, 4)
    permutation = torch.randperm(80, generator=torch.Generator().manual_seed(0))
    shuffled = [*(x[:, permutation] for x in scene[:2]), *(x[permutation] for x in scene[2:4]), *scene[4:]]
    assert torch.equal(rasterize(*scene, WIDTH, HEIGHT)[0], rasterize(*shuffled, WIDTH, HEIGHT)[0])


def test_kept_buffers_change_nothing():
    scene = random_scene(2, 80, 1, WIDTH, HEIGHT, 4)
    buffers = RenderBuffers()
    for _ in range(2):
        expected, expected_grads = render_with_gradients(rasterize, scene)
        actual, grads = render_with_gradients(rasterize, scene, buffers=buffers)
        pairs = zip((*expected, *expected_grads), (*actual, *grads), strict=True)
        assert all(torch.equal(a, b) for a, b in pairs)


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
    assert torch.equal(images, torch.tensor(BACKGROUND, dtype=torch.float64).expand_as(images))
    assert alphas.abs().max() == 0
    assert all(grad.abs().max() == 0 for grad in grads)


def test_shape_errors_name_the_argument():
    scene = random_scene(1, 10, 1, WIDTH, HEIGHT, 1)
    with refused("rasterize: opacities"):
        rasterize(scene[0], scene[1], scene[2][:5], *scene[3:], WIDTH, HEIGHT)
    with refused("rasterize: sh"):
        rasterize(*scene[:3], scene[3].float(), *scene[4:], WIDTH, HEIGHT)
