"""From particles to the image loss: fused kernels against plain torch, and parts of frames against all at once."""

import weakref

import pytest
import torch

from neuma_lib.coupling.deformation import arms_at_rest, deform
from neuma_lib.coupling.filmed import Filmed
from neuma_lib.coupling.particle_binding import bind
from neuma_lib.fitting.frame_batches import evaluate_in_batches, frame_batches
from neuma_lib.fitting.material import PixelLoss
from neuma_lib.sim.state import Trajectory
from neuma_lib.splatting.image_loss import mean_squared_error
from neuma_lib.splatting.observation import Observation, over_white
from neuma_lib.splatting.rasterizer import rasterize, rasterized_error
from tests.support.errors import refused
from tests.support.grounding_scene import ball, camera
from tests.support.random_bodies import random_gaussians, random_particles
from tests.support.render_scenes import BACKGROUND, SMOOTH, assert_slope, dense, random_scene

pytestmark = pytest.mark.core

DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
    ),
]
TOLERANCE = {torch.float64: 1e-12, torch.float32: 3e-6}


def normal(*shape, seed, dtype=torch.float64, device="cpu"):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype).to(device)


def random_pixels(*shape):
    generator = torch.Generator().manual_seed(0)
    return torch.randint(0, 256, (*shape, 4), dtype=torch.uint8, generator=generator)


def assert_near(a, b, dtype):
    assert float((a - b).abs().max()) <= TOLERANCE[dtype] * float(b.abs().max())


# ---- squared error


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", [(3, 1, 5, 7), (2, 3, 96, 80)])
def test_squared_error_of_bytes_is_that_of_their_colours_over_white(shape, dtype, device):
    images = (0.5 + 0.3 * normal(*shape, 3, seed=1, dtype=dtype, device=device)).requires_grad_()
    observed = random_pixels(*shape).to(device)
    colours = over_white(observed.to(dtype) / 255)
    weight = torch.linspace(0.5, 2, shape[0]).to(images)
    values = [mean_squared_error(images, seen) for seen in (observed, colours)]
    grads = [torch.autograd.grad(value, images, weight)[0] for value in values]
    assert_near(*(value.detach() for value in values), dtype)
    assert_near(*grads, dtype)


def test_a_large_image_keeps_its_precision_in_float32():
    observed = torch.full((1, 1, 800, 800, 4), 255, dtype=torch.uint8)
    observed[..., :3] = 102
    images = torch.full((1, 1, 800, 800, 3), 0.5)
    assert float(mean_squared_error(images, observed)) == pytest.approx(0.01, rel=1e-6)


def test_images_of_another_shape_are_refused():
    with refused("image loss: observed"):
        mean_squared_error(torch.zeros(2, 1, 4, 4, 3), random_pixels(3, 1, 4, 4))


def test_observed_images_on_another_device_are_refused():
    with refused("image loss: observed"):
        mean_squared_error(torch.zeros(1, 1, 4, 4, 3), random_pixels(1, 1, 4, 4).to("meta"))


# ---- squared error of a render


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("decoded", [True, False])
def test_error_of_a_render_is_that_of_its_images(dtype, decoded):
    """On a CPU up to the order of sums; `test_splat_tiles.py` has the twin of what a GPU does."""
    scene = random_scene(3, 60, 2, 26, 21, 4, scale=0.05, dtype=dtype)
    observed = random_pixels(3, 2, 21, 26)
    if not decoded:
        observed = over_white(observed.to(dtype) / 255)
    actual = []
    for drawn in (False, True):
        inputs = [tensor.clone().requires_grad_() for tensor in scene[:4]]
        setting = (*inputs, *scene[4:], 26, 21)
        if drawn:
            losses = rasterized_error(*setting, observed, background=BACKGROUND, eps2d=0.1)
        else:
            images, _ = rasterize(*setting, background=BACKGROUND, eps2d=0.1)
            losses = mean_squared_error(images, observed)
        weight = torch.tensor([0.5, 0.0, 3.0], dtype=dtype)
        actual.append([losses.detach(), *torch.autograd.grad(losses, inputs, weight)])
    bound = 20 * torch.finfo(dtype).eps
    assert all((a - b).norm() <= bound * a.norm() for a, b in zip(*actual, strict=True))


@pytest.mark.parametrize("index", range(4), ids=["means", "covars", "opacities", "sh"])
def test_gradient_of_the_error_of_a_render(index):
    """Against central differences of fourth order, in float64, of a smooth render."""
    scene = random_scene(2, 30, 2, 26, 21, 4, scale=0.05)
    observed = random_pixels(2, 2, 21, 26)
    direction = normal(*scene[index].shape, seed=3) * (1e-3 if index == 1 else 1.0)

    def loss(value):
        inputs = [*scene[:index], value, *scene[index + 1 :]]
        losses = rasterized_error(*inputs, 26, 21, observed, **SMOOTH)
        return (losses * torch.tensor([0.3, 2.0])).sum()

    assert_slope(loss, scene[index], direction)


@pytest.mark.parametrize("device", DEVICES)
def test_a_render_of_another_size_is_not_compared(device):
    scene = [tensor.float().to(device) for tensor in random_scene(2, 5, 1, 8, 8, 1)]
    for shape in ((1, 1, 8, 8), (2, 2, 8, 8), (2, 1, 8, 9)):
        with refused("image loss: observed"):
            rasterized_error(*scene, 8, 8, random_pixels(*shape).to(device))


def test_error_of_an_exposure_is_that_of_its_mean():
    """Renders are averaged before they are compared, and masks are compared as masks."""
    body, x, F = moving_ball(torch.float64, "cpu", frames=3)
    video = Observation((0,), random_pixels(1, 1, 32, 32), camera(), exposure=(0, 1, 2))
    renderer = body.particle_gs(camera())
    filmed = Filmed(renderer, video, (0, 1, 2))
    states = filmed.states(x), filmed.states(F)
    expected = mean_squared_error(renderer(x, F).mean(0)[None], video.images)
    assert_near(filmed.error(*states, video.stored()), expected, torch.float64)
    at_once = Filmed(renderer, Observation((0,), video.images, camera()), (0,))
    expected = mean_squared_error(renderer(x[:1], F[:1]), video.images)
    assert_near(at_once.error(x[:1], F[:1], video.stored()), expected, torch.float64)
    masks = Filmed(renderer, video, (0, 1, 2), "masks")
    expected = mean_squared_error(renderer.coverage(x, F).mean(0)[None], video.coverage())
    assert_near(masks.error(*states, video.coverage()), expected, torch.float64)


# ---- deformation


def three_equations(means, covars, binding, x0, x, F, arms=None):
    """x_t = x_0 + B (p_t - p_0), or B p_t + F_bar a; A_t = F_bar A_0 F_bar^T with F_bar = B F; as they stand."""
    B = dense(binding)
    F_bar = torch.einsum("gn,tnij->tgij", B, F)
    moved = means + torch.einsum("gn,tni->tgi", B, x - x0)
    if arms is not None:
        bound = (binding.counts > 0)[:, None]
        moved = torch.where(
            bound, torch.einsum("gn,tni->tgi", B, x) + (F_bar @ arms[..., None])[..., 0], moved
        )
    return moved, F_bar @ covars @ F_bar.mT


def deformation(dtype, device, frames=4):
    means, covars = random_gaussians(70, seed=14, size=0.05)
    particles = random_particles(90, seed=15)
    binding = bind(means, covars, particles)
    assert (binding.counts == 0).any(), "a Gaussian without particles must be covered"
    assert len(torch.unique(binding.indices)) < 90, "a particle without Gaussians must be covered"
    x = particles + 0.1 * normal(frames, 90, 3, seed=1)
    F = torch.eye(3) + 0.3 * normal(frames, 90, 3, 3, seed=2)
    at_rest = [value.to(device, dtype) for value in (means, covars, particles)]
    moved = [value.to(device, dtype).requires_grad_() for value in (x, F)]
    return binding.to(device, dtype), *at_rest, *moved


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("affine", [False, True])
def test_fused_deformation_is_the_three_equations(dtype, device, affine):
    binding, means, covars, x0, x, F = deformation(dtype, device)
    arms = arms_at_rest(means, binding, x0) if affine else None
    cotangents = [
        normal(4, 70, *shape, seed=3, dtype=dtype, device=device) for shape in ((3,), (3, 3))
    ]  # the second is not symmetric
    results = []
    for way in (deform, three_equations):
        out = way(means, covars, binding, x0, x, F, arms=arms)
        results.append([*(o.detach() for o in out), *torch.autograd.grad(out, (x, F), cotangents)])
    for fused, plain in zip(*results, strict=True):
        assert_near(fused, plain, dtype)


def test_gradient_stops_at_the_covariances_on_request():
    binding, means, covars, x0, x, F = deformation(torch.float64, "cpu")
    moved, stretched = deform(means, covars, binding, x0, x, F, covariance_gradient=False)
    weight = normal(4, 70, 3, seed=4)
    actual = torch.autograd.grad((weight * moved).sum() + stretched.sum(), (x, F), allow_unused=True)
    expected = torch.einsum("gn,tgi->tni", dense(binding), weight)
    assert_near(actual[0], expected, torch.float64)
    assert actual[1] is None


def test_states_of_other_particles_are_refused():
    binding, means, covars, x0, x, F = deformation(torch.float64, "cpu")
    with refused("deform: x"):
        deform(means, covars, binding, x0, x[:, 1:], F)
    with refused("deform: F"):
        deform(means, covars, binding, x0, x, F.float())


# ---- parts of frames


@pytest.mark.parametrize(("count", "size"), [(1, 1), (7, 3), (8, 4), (33, 8), (5, 100)])
def test_parts_cover_all_frames_evenly(count, size):
    actual = list(frame_batches(count, size))
    assert [i for part in actual for i in range(count)[part]] == list(range(count))
    lengths = [part.stop - part.start for part in actual]
    assert max(lengths) <= size and max(lengths) - min(lengths) <= 1
    assert len(actual) == -(-count // size)


@pytest.mark.parametrize("size", [1, 2, 5, 9])
def test_frames_in_parts_give_the_value_and_gradient_of_all_at_once(size):
    x, F = normal(9, 4, 3, seed=5).requires_grad_(), normal(9, 4, 3, 3, seed=6).requires_grad_()
    unused = normal(9, seed=7).requires_grad_()
    offset = normal(9, seed=8)

    def function(part, x, F, unused):
        return offset[part] * (F @ x[..., None]).sin().flatten(1).sum(1)

    weight = normal(9, seed=9)
    whole = function(slice(None), x, F, unused)
    split = evaluate_in_batches(function, size, x, F, unused)
    assert torch.allclose(split, whole, rtol=1e-14)
    expected = torch.autograd.grad(whole, (x, F), weight)
    actual = torch.autograd.grad(split, (x, F, unused), weight, allow_unused=True, retain_graph=True)
    for a, b in zip(actual, expected, strict=False):
        assert torch.allclose(a, b, rtol=1e-13)
    assert actual[2] is None
    again = torch.autograd.grad(split, (x, F), weight)
    assert torch.equal(again[0], actual[0]) and torch.equal(again[1], actual[1])
    with torch.no_grad():
        assert torch.equal(evaluate_in_batches(function, size, x, F, unused), split)


def test_memory_of_a_part_is_released():
    """If gradients are required, the memory of one part for its backward pass is free when the next one starts."""
    alive = []

    class Held(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            assert not any(reference() is not None for reference in alive)
            buffer = torch.ones(3)
            alive.append(weakref.ref(buffer))
            ctx.buffer = buffer
            return x.sum(1)

        @staticmethod
        def backward(ctx, grad):
            return grad[:, None].expand(-1, 2)

    x = torch.ones(6, 2, requires_grad=True)
    evaluate_in_batches(lambda _, x: Held.apply(x), 2, x).sum().backward()
    assert len(alive) == 3 and torch.equal(x.grad, torch.ones(6, 2))


# ---- the whole loss


def moving_ball(dtype, device, frames=5):
    body = ball(dtype=dtype).to(dtype, device)
    steps = torch.linspace(0, 1, frames).to(body.x0)[:, None, None]
    x = body.x0 + steps * torch.tensor([0.02, -0.05, 0.01]).to(body.x0)
    F = torch.eye(3).to(body.x0) + steps[..., None] * 0.1 * normal(len(x[0]), 3, 3, seed=3).to(body.x0)
    return body, x.contiguous(), F.contiguous()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("covariance_gradient", [True, False])
def test_pixel_loss_is_equation_2_whatever_the_batch(dtype, device, covariance_gradient):
    body, x, F = moving_ball(dtype, device)
    cameras = camera(dtype=dtype).to(device=device)
    video = Observation(tuple(range(5)), random_pixels(5, 1, 32, 32), cameras).to(dtype, device)
    x, F = x.requires_grad_(), F.requires_grad_()
    weight = torch.linspace(2, 1, 5).to(x)

    def value_and_gradients(losses):
        grads = torch.autograd.grad(losses, (x, F), weight, allow_unused=True)
        return losses.detach(), *grads

    renderer = body.particle_gs(cameras, covariance_gradient=covariance_gradient)
    expected = value_and_gradients((renderer(x, F) - video.colours()).square().flatten(1).mean(1))
    for batch in (None, 1, 2):
        loss = PixelLoss(body, video, covariance_gradient, batch)
        actual = value_and_gradients(loss(Trajectory(video.frames, x, x, F, F)))
        for mine, twin in zip(actual, expected, strict=True):
            assert (mine is None and twin is None) or torch.allclose(
                mine, twin, rtol=1e3 * TOLERANCE[dtype], atol=10 * TOLERANCE[dtype] * float(twin.abs().max())
            )
        assert (actual[2] is None) == (not covariance_gradient)


def test_batches_of_a_renderer_are_its_images():
    body, x, F = moving_ball(torch.float64, "cpu")
    renderer = body.particle_gs(camera())
    pieces = list(renderer.batches(x, F, 2))
    assert [part.start for part, _ in pieces] == [0, 2, 4]
    assert torch.equal(torch.cat([images for _, images in pieces]), renderer(x, F))


# ---- observations


def test_colours_of_an_observation_are_over_white():
    cameras = camera(4, dtype=torch.float32)
    pixels = random_pixels(3, 1, 4, 4)
    pixels[0, 0, 0, 0] = torch.tensor([10, 20, 30, 0])
    pixels[0, 0, 0, 1] = torch.tensor([51, 102, 255, 255])
    video = Observation((0, 2, 5), pixels, cameras)
    colours = video.colours()
    assert colours.dtype == torch.float32 and colours.shape == (3, 1, 4, 4, 3)
    assert colours[0, 0, 0, 0].tolist() == [1, 1, 1]
    assert torch.allclose(colours[0, 0, 0, 1], torch.tensor([0.2, 0.4, 1.0]))
    assert torch.equal(video.colours(slice(1, 3)), colours[1:])
    assert video.to(torch.float64).images.dtype == torch.uint8
    assert torch.allclose(video.to(torch.float64).colours(), colours.double(), atol=1e-6)
    assert torch.equal(video.select([0, 2]).images, pixels[[0, 2]])
    rendered = Observation((0, 2, 5), colours, cameras)
    assert torch.equal(rendered.colours([1]), colours[1:2])
    assert rendered.to(torch.float64).images.dtype == torch.float64


@pytest.mark.parametrize(
    "images", [torch.zeros(2, 1, 4, 4, 4), torch.zeros(2, 1, 4, 5, 3), torch.zeros(2, 2, 4, 4, 3)]
)
def test_images_that_do_not_fit_the_cameras_are_refused(images):
    with refused("observation: images"):
        Observation((0, 1), images, camera(4))
