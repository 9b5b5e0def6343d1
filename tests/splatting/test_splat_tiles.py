"""The tile compositor: its lists against brute force, its images and gradients against the torch twin in float64.

On a GPU the kernels themselves run; everywhere the same CUDA code runs compiled for the CPU, lane by lane.
"""

import pytest
import torch

from benchmarks import gsplat_backend, torch_rasterizer
from neuma_lib.splatting import compositor_cuda, projection, rasterizer
from neuma_lib.splatting.compositing import Settings
from neuma_lib.splatting.image_loss import mean_squared_error
from neuma_lib.splatting.rasterizer import RenderBuffers, Statistics, rasterize, rasterized_error
from tests.support.emulated_cuda import COMPILER, EmulatedTiles
from tests.support.errors import refused
from tests.support.render_scenes import (
    BACKGROUND,
    LOOSE,
    SMOOTH,
    assert_each_image_is_rendered_alone,
    random_scene,
    with_gradients,
)

pytestmark = pytest.mark.core

CUDA = pytest.param(
    "cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
)
EMULATED = pytest.param("emulated", marks=pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler"))


@pytest.fixture(scope="session")
def build_folder(tmp_path_factory):
    return tmp_path_factory.mktemp("tiles")


@pytest.fixture(params=[EMULATED, CUDA])
def render(request, monkeypatch, build_folder):
    """``rasterize`` in float32 with the tile compositor, on copies of float64 inputs that keep the graph."""

    def run(*arguments, **options):
        tensors, size = arguments[:6], arguments[6:]
        if request.param == "cuda":
            outputs = rasterize(*(tensor.float().cuda() for tensor in tensors), *size, **options)
        else:
            with monkeypatch.context() as patch:
                patch.setitem(rasterizer.COMPOSITORS, "rows", EmulatedTiles(build_folder))
                outputs = rasterize(*(tensor.float() for tensor in tensors), *size, **options)
        return tuple(output.to("cpu", torch.float64) for output in outputs)

    return run


def check_images(images, alphas, expected, expected_alphas):
    error = (images - expected).abs()
    assert error.mean() < 1e-5
    assert (error.amax(dim=-1) > 1 / 255).double().mean() <= 1e-3
    assert (alphas - expected_alphas).abs().mean() < 1e-5


def opaque(scene):
    scene[2] = 0.97 + 0.029 * scene[2]
    return scene


SCENES = {
    "default": (lambda: random_scene(2, 120, 2, 37, 29, 4, scale=0.04), 37, 29, {}),
    "smooth": (lambda: random_scene(1, 60, 1, 35, 20, 9, scale=0.04), 35, 20, SMOOTH),
    "loose": (lambda: random_scene(1, 100, 2, 21, 33, 16, scale=0.06), 21, 33, LOOSE),
    "capped": (lambda: opaque(random_scene(1, 40, 1, 40, 40, 1, scale=0.1)), 40, 40, {}),
    "huge": (lambda: random_scene(1, 20, 1, 70, 50, 1, scale=2.0), 70, 50, {}),
    "tiny": (lambda: random_scene(1, 300, 1, 50, 50, 1, scale=0.002), 50, 50, {}),
    "needles": (lambda: needles(random_scene(1, 60, 1, 48, 48, 1)), 48, 48, {"eps2d": 0.01}),
    "one pixel": (lambda: random_scene(1, 40, 1, 16, 16, 1, scale=0.1), 1, 1, {}),
}


def needles(scene):
    axis = torch.nn.functional.normalize(scene[0][0], dim=-1)
    scene[1] = (0.15**2 * axis[:, :, None] * axis[:, None] + 1e-6 * torch.eye(3, dtype=axis.dtype))[None]
    return scene


@pytest.mark.parametrize("name", SCENES)
def test_equals_the_twin(render, name):
    make, width, height, options = SCENES[name]
    scene = make()
    expected, expected_grads = with_gradients(torch_rasterizer.rasterize, scene, width, height, **options)
    actual, grads = with_gradients(render, scene, width, height, **options)
    check_images(*actual, *expected)
    for a, b in zip(expected_grads, grads, strict=True):
        assert (a - b).norm() < 1e-3 * a.norm()


@pytest.mark.parametrize("tile, lane_pixels", [(8, 1), (8, 2), (16, 4), (32, 2)])
@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
def test_other_tile_sizes(tile, lane_pixels, monkeypatch, build_folder):
    scene = [tensor.float() for tensor in random_scene(1, 60, 1, 37, 29, 1, scale=0.04)]
    expected, expected_grads = with_gradients(rasterize, scene, 37, 29)
    monkeypatch.setitem(rasterizer.COMPOSITORS, "rows", EmulatedTiles(build_folder, tile, lane_pixels))
    actual, grads = with_gradients(rasterize, scene, 37, 29)
    for a, b in zip((*expected, *expected_grads), (*actual, *grads), strict=True):
        assert (a - b).norm() < 1e-4 * a.norm()


def test_empty_images(render):
    scene = random_scene(2, 10, 1, 37, 29, 1)
    scene[0] = scene[0] + 100.0
    (images, alphas), grads = with_gradients(render, scene, 37, 29)
    assert torch.equal(images.float(), torch.tensor(BACKGROUND).expand_as(images))
    assert alphas.abs().max() == 0
    assert all(grad.abs().max() == 0 for grad in grads)


def test_a_batch_equals_single_calls(render):
    scene = random_scene(3, 80, 2, 37, 29, 4, scale=0.03)
    assert_each_image_is_rendered_alone(render, scene, 37, 29)


def test_statistics(render):
    scene = random_scene(1, 40, 3, 37, 29, 1)
    scene[2][0] = 1e-4  # too faint to be drawn
    of_tiles, of_rows = Statistics(), Statistics()
    with_gradients(render, scene, 37, 29, statistics=of_tiles)
    with_gradients(rasterize, scene, 37, 29, statistics=of_rows)
    assert torch.equal(of_tiles.views.cpu(), of_rows.views)
    difference = of_tiles.screen_gradients.cpu().double() - of_rows.screen_gradients
    assert difference.norm() < 1e-3 * of_rows.screen_gradients.norm()


def frame_errors(function, device, scene, observed, width, height, **options):
    """Losses (T,) of a render and gradients of all inputs, with a weight per frame."""
    inputs = [tensor.float().to(device) for tensor in scene]
    leaves = [tensor.requires_grad_() for tensor in inputs[:4]]
    losses = function(*inputs, width, height, observed.to(device), background=BACKGROUND, **options)
    weights = torch.linspace(0.2, 3.0, len(losses)).to(device)
    grads = torch.autograd.grad((weights * losses).sum(), leaves)
    return [value.detach().to("cpu", torch.float64) for value in (losses, *grads)]


def error_of_images(*arguments, **options):
    *scene, observed = arguments
    return mean_squared_error(rasterize(*scene, **options)[0], observed)


def aside(scene):
    """The first frame out of sight."""
    scene[0][0] += 100.0
    return scene


COMPARED = SCENES | {
    "several frames and views": (lambda: random_scene(3, 150, 2, 53, 41, 4, scale=0.02), 53, 41, {}),
    "a frame without splats": (lambda: aside(random_scene(2, 50, 2, 37, 29, 4, scale=0.03)), 37, 29, {}),
    "empty tiles": (lambda: random_scene(2, 3, 1, 150, 90, 1, scale=0.01), 150, 90, {}),
    "no splats at all": (lambda: aside(random_scene(1, 5, 2, 37, 29, 1)), 37, 29, {}),
}


@pytest.fixture(params=[EMULATED, CUDA])
def device(request, monkeypatch, build_folder):
    """Device on which the tile compositor runs. In an emulation it replaces the compositor of the CPU."""
    if request.param == "cuda":
        return "cuda"
    monkeypatch.setitem(rasterizer.COMPOSITORS, "rows", EmulatedTiles(build_folder))
    return "cpu"


@pytest.mark.parametrize("name", COMPARED)
def test_direct_error_is_that_of_the_images(name, device, monkeypatch):
    """Images, their loss and its gradient one after the other are the twin; only the order of sums differs."""
    make, width, height, options = COMPARED[name]
    scene = make()
    shape = (len(scene[0]), len(scene[4]), height, width, 4)
    observed = torch.randint(0, 256, shape, dtype=torch.uint8, generator=torch.Generator().manual_seed(2))
    setting = (device, scene, observed, width, height)
    expected = frame_errors(error_of_images, *setting, **options)
    drawn = []
    with monkeypatch.context() as patch:
        patch.setattr(rasterizer, "mean_squared_error", lambda *_: pytest.fail("images were compared"))
        for _ in range(2):
            drawn.append(frame_errors(rasterized_error, *setting, **options))
    assert torch.equal(drawn[0][0], drawn[1][0]), "sums have a fixed order"
    # covariances of needles are badly conditioned: the twin's own gradients are 1e-4 away from those in float64
    bound = 1e-3 if name == "needles" else 5e-6
    for actual, twin in zip(drawn[0], expected, strict=True):
        assert (actual - twin).norm() <= bound * twin.norm()
    assert all(bool(grad.abs().max() > 0) == (name != "no splats at all") for grad in drawn[0][1:3])


@pytest.mark.parametrize("wanted", [[0], [1], [0, 1], [0, 1, 3], [2], [3]])
def test_omitted_gradients_change_no_other(wanted, device):
    """Other code runs without those of opacities."""
    scene = [tensor.float().to(device) for tensor in random_scene(2, 80, 2, 37, 29, 4, scale=0.04)]
    observed = torch.full((2, 2, 29, 37, 4), 99, dtype=torch.uint8, device=device)
    actual = []
    for leaves in (range(4), wanted):
        inputs = [tensor.clone().requires_grad_(i in leaves) for i, tensor in enumerate(scene[:4])]
        losses = rasterized_error(*inputs, *scene[4:], 37, 29, observed)
        losses.sum().backward()
        actual.append([tensor.grad for tensor in inputs])
    for i, (all_wanted, some_wanted) in enumerate(zip(*actual, strict=True)):
        if i not in wanted:
            assert some_wanted is None
        else:
            assert (some_wanted - all_wanted).norm() <= 5e-6 * all_wanted.norm()


@pytest.mark.parametrize("tile, lane_pixels", [(8, 1), (16, 4), (32, 2)])
@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
def test_errors_of_other_tile_sizes(tile, lane_pixels, monkeypatch, build_folder):
    scene = random_scene(2, 60, 1, 37, 29, 1, scale=0.04)
    observed = torch.full((2, 1, 29, 37, 4), 77, dtype=torch.uint8)
    setting = ("cpu", scene, observed, 37, 29)
    expected = frame_errors(error_of_images, *setting)
    monkeypatch.setitem(rasterizer.COMPOSITORS, "rows", EmulatedTiles(build_folder, tile, lane_pixels))
    for actual, twin in zip(frame_errors(rasterized_error, *setting), expected, strict=True):
        assert (actual - twin).norm() <= 1e-4 * twin.norm()


def project(scene, width, height, alpha_min=1 / 255, eps2d=0.3):
    settings = Settings(width, height, alpha_min, 0.99, 1e-4, eps2d)
    return projection.project(*(tensor.float() for tensor in scene), settings, RenderBuffers().empty)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("tile", [8, 16])
def test_lists_are_complete_and_tight(name, tile):
    make, width, height, options = SCENES[name]
    alpha_min = options.get("alpha_min", 1 / 255)
    splats, depths = project(make(), width, height, alpha_min, options.get("eps2d", 0.3))
    ids, starts = compositor_cuda.lists(splats, depths, width, height, tile)
    x, y = torch.arange(width).double() + 0.5, torch.arange(height).double() + 0.5
    tiles_x, tiles_y = -(-width // tile), -(-height // tile)
    assert len(starts) == len(splats) * tiles_x * tiles_y + 1 and starts[-1] == len(ids)
    for t in range(len(starts) - 1):
        image, row, column = t // (tiles_x * tiles_y), t // tiles_x % tiles_y, t % tiles_x
        entries = ids[starts[t] : starts[t + 1]].long() - image * depths.shape[1]
        assert (depths[image, entries].diff() >= 0).all() and len(entries.unique()) == len(entries)
        mx, my, A, B, C, opacity = splats[image, :, :6].double().T[:, :, None, None]
        dx = x[column * tile : (column + 1) * tile] - mx
        dy = y[row * tile : (row + 1) * tile, None] - my
        q = A * dx * dx + 2 * B * dx * dy + C * dy * dy
        visible = depths[image] < projection.CULLED
        drawn = visible & ((opacity * torch.exp(-q / 2)).amax(dim=(1, 2)) >= alpha_min)
        listed = torch.zeros_like(drawn)
        listed[entries] = True
        assert not (drawn & ~listed).any()
        # the ellipse, a little larger, meets the rectangle of pixel centres: on a grid five times finer
        fine_x = torch.linspace(0, 1, 5 * (dx.shape[-1] - 1) + 1, dtype=dx.dtype) * (dx.shape[-1] - 1)
        fine_y = torch.linspace(0, 1, 5 * (dy.shape[-2] - 1) + 1, dtype=dy.dtype) * (dy.shape[-2] - 1)
        dx, dy = dx[..., :1] + fine_x, dy[:, :1] + fine_y[:, None]
        near = (A * dx * dx + 2 * B * dx * dy + C * dy * dy).amin(dim=(1, 2))
        radius = torch.sqrt(splats[image, :, 10].double() * splats[image, :, 11].double()).clamp_min(1.0)
        thin = torch.minimum(splats[image, :, 10], splats[image, :, 11]) < 2.0
        far = near > splats[image, :, 9].double() * (1 + 1.0 / radius) ** 2
        assert not (listed & far & ~thin).any()


def test_lists_of_no_splats():
    for count in (0, 3):
        depths = torch.full((2, count), projection.CULLED)
        ids, starts = compositor_cuda.lists(torch.zeros(2, count, 12), depths, 20, 20, 16)
        assert len(ids) == 0 and torch.equal(starts, torch.zeros(9, dtype=torch.int32))


def test_non_finite_splats_are_not_listed():
    scene = random_scene(1, 20, 1, 37, 29, 1, dtype=torch.float32)
    scene[0][0, 0] = float("nan")
    scene[1][0, 1] = float("nan")
    scene[1][0, 2] = float("inf")
    scene[2][3] = float("nan")
    splats, depths = project(scene, 37, 29)
    ids, starts = compositor_cuda.lists(splats, depths, 37, 29, 16)
    assert not torch.isin(torch.arange(4, dtype=torch.int32), ids).any()
    assert torch.isfinite(splats.view(-1, 12)[ids.long()]).all()


def test_errors_name_compositors_that_work():
    scene = random_scene(1, 10, 1, 16, 16, 1)
    for compositor in ("tiles", "gsplat", "columns"):
        with refused("rasterize: compositor") as error:
            rasterize(*scene, 16, 16, compositor=compositor)
        assert "rows" in error.value.remedy


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_equals_gsplat_image_by_image():
    pytest.importorskip("gsplat", exc_type=ImportError)
    scene = random_scene(3, 2000, 2, 150, 100, 16, scale=0.01, dtype=torch.float32)
    results = []
    for render in (rasterize, gsplat_backend.rasterize):
        inputs = [tensor.cuda().requires_grad_() for tensor in scene[:4]]
        cameras = [tensor.cuda() for tensor in scene[4:]]
        images, alphas = render(*inputs, *cameras, 150, 100, background=BACKGROUND, alpha_max=0.999)
        weights = torch.linspace(-1, 1, images.numel(), device="cuda").view_as(images)
        grads = torch.autograd.grad((weights * images).sum() + alphas.sum(), inputs)
        results.append((images, alphas, grads))
    (images, alphas, grads), (expected, expected_alphas, expected_grads) = results
    for t in range(3):
        for v in range(2):
            error = (images[t, v] - expected[t, v]).abs()
            assert error.mean() < 1e-4 and (error.amax(dim=-1) > 2 / 255).float().mean() < 1e-3
    assert (alphas - expected_alphas).abs().mean() < 1e-4
    for a, b in zip(grads, expected_grads, strict=True):
        assert (a - b).norm() < 1e-2 * a.norm()
