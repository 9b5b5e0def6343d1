"""Measures compared with their definitions, and the tables and videos that contain them."""

import math

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image, ImageSequence

from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.evaluation.image_metrics import psnr, ssim
from neuma_lib.evaluation.metrics import mean_height, mechanical_energy, tracer_errors
from neuma_lib.evaluation.text_tables import report_table
from neuma_lib.evaluation.video import side_by_side, write_gif, write_mp4
from neuma_lib.geometry.chamfer import chamfer_loss, chamfer_sequence
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.paper.published import BALL_PARTICLES, BALL_RADIUS, PAPER
from tests.support.errors import refused


def points(*shape, seed=0):
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def brute_force(a, b):
    squared = (a[:, None] - b[None]).square().sum(-1)
    return squared.min(1).values.mean() + squared.min(0).values.mean()


def chamfer(a, b):
    """Chamfer distance of two point sets [1e-4 m^2]."""
    return float(chamfer_sequence(torch.as_tensor(a)[None], torch.as_tensor(b)[None]))


def test_chamfer_equals_its_definition():
    a, b = points(70, seed=1), points(45, seed=2)
    assert chamfer(a, b) == pytest.approx(1e4 * float(brute_force(a, b)), rel=1e-12)
    assert chamfer(a, b) == pytest.approx(chamfer(b, a), rel=1e-12)
    assert chamfer(a, a) == 0.0
    assert chamfer(torch.zeros(1, 3), torch.tensor([[0.03, 0, 0.04]])) == pytest.approx(2 * 25.0)


def test_chamfer_of_a_sequence_is_frame_by_frame():
    a, b = points(3, 50, seed=3), points(3, 40, seed=4)
    assert chamfer_sequence(a, b).tolist() == [chamfer(x, y) for x, y in zip(a, b, strict=True)]


def test_chamfer_loss_and_its_gradient():
    """Value against the definition for targets of any size; gradient against central differences."""
    x = points(3, 25, seed=5).requires_grad_()
    targets = [points(n, seed=10 + n) for n in (30, 18, 25)]
    loss = chamfer_loss(x, targets)
    torch.testing.assert_close(
        loss, torch.stack([brute_force(a, b) for a, b in zip(x, targets, strict=True)])
    )
    weights = torch.tensor([1.0, -0.5, 2.0], dtype=torch.float64)
    (gradient,) = torch.autograd.grad((weights * loss).sum(), x)
    for seed in range(5):
        direction = points(3, 25, seed=20 + seed) - 0.5
        h = 1e-6  # far below the distances at which a nearest neighbour changes
        with torch.no_grad():
            ahead, behind = (
                float((weights * chamfer_loss(x + s * direction, targets)).sum()) for s in (h, -h)
            )
        assert float((gradient * direction).sum()) == pytest.approx((ahead - behind) / (2 * h), rel=1e-7)


def test_chamfer_loss_names_invalid_input():
    with refused("chamfer_loss"):
        chamfer_loss(points(2, 5), [points(5)])
    broken = points(2, 5)
    broken[1, 3, 0] = float("nan")
    with pytest.raises(NonFiniteError, match="particle 3 of frame 1"):
        chamfer_loss(broken, points(2, 5))


def test_tracer_error_of_a_shift_is_its_length():
    path = points(4, 30)
    shift = torch.tensor([3e-3, 0.0, 4e-3], dtype=torch.float64)
    errors = tracer_errors(path + shift, path)
    assert errors.pop("tracer_rmse_mm_per_frame") == pytest.approx([5] * 4)
    assert list(errors.values()) == pytest.approx([5] * 3)
    with pytest.raises(InputError, match="differ"):
        tracer_errors(path, path[:, 1:])


def test_tracer_error_over_points_and_frames():
    """Point k of frame t is off by t k mm: errors of all points in all frames count alike."""
    t, k = torch.meshgrid(torch.arange(10.0), torch.arange(10.0), indexing="ij")
    off = torch.zeros(10, 10, 3)
    off[..., 1] = 1e-3 * t * k
    errors = tracer_errors(points(10, 10) + off, points(10, 10))
    squares = np.arange(10.0) ** 2
    assert errors["tracer_rmse_mm"] == pytest.approx(squares.mean())
    assert errors["tracer_rmse_last_mm"] == pytest.approx(9 * math.sqrt(squares.mean()))
    assert errors["tracer_error_p95_mm"] == pytest.approx(np.quantile((t * k).numpy(), 0.95))


def test_energy_is_constant_on_a_parabola():
    g, mass, time = torch.tensor([0.5, -9.8, 0.0]), torch.tensor([2.0, 3.0]), torch.linspace(0, 0.3, 4)
    v0, x0 = points(2, seed=1), points(2, seed=2)
    v = v0 + time[:, None, None].double() * g
    x = x0 + time[:, None, None] * v0 + 0.5 * time[:, None, None] ** 2 * g
    energy = mechanical_energy(x, v, mass, g.tolist())
    torch.testing.assert_close(energy, energy[:1].expand(4), rtol=1e-6, atol=0)
    # At rest in the lowest corner there is none: least x, since gravity points along it, and so on.
    at_rest = mechanical_energy(torch.tensor([[[1.0, 0, 0]]]), torch.zeros(1, 1, 3), mass[:1], g.tolist())
    assert float(at_rest) == pytest.approx(0, abs=1e-6)


# ---- what the Chamfer distance of filled bodies sees

RADIUS, POINTS = 0.13, 20_000


def mean_square_nearest(volume: float, count: int) -> float:
    """Mean squared distance [m^2] to the nearest of random points of a density: r^3 is exponentially distributed."""
    return math.gamma(5 / 3) * (3 * volume / (4 * math.pi * count)) ** (2 / 3)


def ball_points(count: int, radius: float, seed: int, method: str = "uniform") -> np.ndarray:
    return sample_volume(trimesh.creation.icosphere(5, radius), count, seed, method)


def test_the_papers_distance_on_its_ball_is_its_floor():
    """The paper's 1.19 lies between two random sets of points of the same ball, on jittered grids and independent."""
    floors = {
        method: chamfer(*(ball_points(BALL_PARTICLES, BALL_RADIUS, seed, method) for seed in (0, 1)))
        for method in ("jittered", "uniform")
    }
    assert floors["jittered"] < PAPER["table1"].rows["neuma"][0] < floors["uniform"]
    assert [round(floor, 1) for floor in floors.values()] == [1.1, 1.3]
    volume = 4 / 3 * math.pi * BALL_RADIUS**3
    inside = 2e4 * mean_square_nearest(volume, BALL_PARTICLES)
    # Points within a spacing of the surface, 3 s / R of all, see half of the space at worst, r^2 times 2^(2/3). Three
    # standard deviations of the mean, of r^2 that deviates by 0.68 of it, two directions with neighbours in common.
    spacing, sampling = (volume / BALL_PARTICLES) ** (1 / 3), 3 * 0.68 * math.sqrt(2 / BALL_PARTICLES)
    cut = 3 * spacing / BALL_RADIUS * (2 ** (2 / 3) - 1)
    assert 1 - sampling < floors["uniform"] / inside < (1 + cut) * (1 + sampling)


def test_chamfer_distance_ignores_the_rotation_of_a_ball():
    truth, again = ball_points(POINTS, RADIUS, 0), ball_points(POINTS, RADIUS, 1)
    turned = again[:, [2, 1, 0]] * [1, 1, -1]  # by 90 degrees about the vertical axis
    error = tracer_errors(torch.from_numpy(turned)[None], torch.from_numpy(again)[None])["tracer_rmse_mm"]
    # Distances from the axis rho have mean rho^2 = 2 R^2 / 5 and mean rho^4 = 8 R^4 / 35.
    assert error == pytest.approx(
        2e3 * math.sin(math.pi / 4) * RADIUS * math.sqrt(2 / 5), rel=3 * 0.33 / math.sqrt(POINTS)
    )
    floor = chamfer(again, truth)
    assert abs(chamfer(turned, truth) - floor) < 3 * 0.68 * floor * math.sqrt(2 / POINTS)


@pytest.mark.parametrize("shift", [0.02, 0.04])
def test_chamfer_excess_of_a_small_motion_is_of_third_order(shift):
    """Only points outside the truth count: crescents of depth d cos(angle), squared distance to the surface.

    Over the front half of a ball both directions give d^3 / (4 R). The nearest sample is further away than the surface,
    by a distance h in quadratic mean (half of the space is empty there), which adds d^2 h / R + 3 d h^2 / (2 R); within
    the body those points had their part of the floor.
    """
    truth, again = ball_points(POINTS, RADIUS, 0), ball_points(POINTS, RADIUS, 1)
    floor = 1e-4 * chamfer(again, truth)
    excess = 1e-4 * chamfer(again + [0, shift, 0], truth) - floor
    h = math.sqrt(2 ** (2 / 3) * mean_square_nearest(4 / 3 * math.pi * RADIUS**3, POINTS))
    sampling = 3 * 0.68 * floor * math.sqrt(2 / POINTS)
    cubic, crescent = shift**3 / (4 * RADIUS), 3 * shift / (4 * RADIUS)
    assert cubic - crescent * floor - sampling < excess
    assert excess < cubic + shift**2 * h / RADIUS + 2 * crescent * h**2 + sampling


def test_mean_height_is_that_of_the_centre_of_mass():
    x = np.zeros((2, 2, 3))
    x[1, :, 1] = [1.0, 4.0]
    assert mean_height(x, np.array([2.0, 1.0])) == pytest.approx([0.0, 2.0])


def test_unusable_points_and_images_are_named():
    with refused("chamfer: b"):
        chamfer(points(4), torch.full((4, 3), float("inf")))
    with refused("chamfer: b"):
        chamfer(points(4), torch.zeros(0, 3))
    with refused("chamfer"):
        chamfer_sequence(points(2, 4), points(3, 4))
    with pytest.raises(InputError, match="differ"):
        psnr(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))
    for size in ((8, 20), (20, 8)):
        with refused("ssim"):
            ssim(np.zeros((*size, 3)), np.zeros((*size, 3)))


def test_report_table_has_a_line_for_each_row():
    text, markdown = report_table({"a": {"n": 3, "q": 0.123456}}, {"n": "count", "q": "quality"}, "scene")
    assert text == "scene,n,q\na,3,0.123456\n"
    assert markdown.splitlines()[-1] == "| a | 3 | 0.1235 |"


@pytest.fixture
def film():
    """A bright square that moves to the right over ten frames."""
    frames = np.zeros((10, 33, 41, 3))
    for t, frame in enumerate(frames):
        frame[10:20, 3 * t : 3 * t + 10] = (1.0, 0.5, 0.2)
    return frames


def test_video_has_both_panels_and_is_reproducible(film, tmp_path):
    video = side_by_side([film, 1 - film], ["observation", "prediction"], magnify=2)
    assert video.dtype == np.uint8 and video.shape == (10, 2 * 33 + 18, 2 * 2 * 41, 3)
    for name in ("first.mp4", "second.mp4"):
        write_mp4(tmp_path / name, video, frame_rate=12)
    assert (tmp_path / "first.mp4").read_bytes() == (tmp_path / "second.mp4").read_bytes()
    read = np.stack(imageio.mimread(tmp_path / "first.mp4"))
    assert read.shape == video.shape
    # The step of H.264 at QP 18, 0.625 * 2^(18 / 6), is 5 levels: its orthonormal transform leaves pixels at most half
    # of that off in quadratic mean. Blocks of 2 x 2 equal pixels lose nothing to the coarser colour planes.
    distances = [[np.sqrt(np.square(a - b).mean()) for b in video.astype(float)] for a in read.astype(float)]
    assert max(np.diag(distances)) < 2.5
    # A frame more or less would be noticed: neighbours are further apart.
    assert (np.argmin(distances, axis=1) == range(10)).all() and np.diag(distances, 1).min() > 5


def test_gif_has_every_frame_and_is_reproducible(film, tmp_path):
    video = side_by_side([film, 1 - film], ["observation", "prediction"], magnify=2)
    for name in ("first.gif", "second.gif"):
        write_gif(tmp_path / name, video, frame_rate=12)
    assert (tmp_path / "first.gif").read_bytes() == (tmp_path / "second.gif").read_bytes()
    with Image.open(tmp_path / "first.gif") as read:
        assert read.n_frames == len(video) and read.info["loop"] == 0
        frames = np.stack([np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(read)])
    # Few colours, which one palette has all; Pillow looks colours up in boxes of 4 levels.
    difference = np.abs(frames.astype(int) - video)
    assert difference[:, 18:].max() < 4 and difference.max() < 16


@pytest.mark.parametrize("rate", [12, 18, 30, 50, 60, 144])
def test_gif_has_the_duration_of_its_frames(tmp_path, rate):
    count = 3 * rate  # three seconds
    video = np.zeros((count, 8, 8, 3), np.uint8)
    video[np.arange(count), :, np.arange(count) % 7] = 255  # none is as the one before
    write_gif(tmp_path / "a.gif", video, rate)
    with Image.open(tmp_path / "a.gif") as read:
        delays = [frame.info["duration"] for frame in ImageSequence.Iterator(read)]
    assert sum(delays) == 3000 and max(delays) - min(delays) <= 10
    assert min(delays) >= 20, "a browser would take 100 ms for less"
    assert len(delays) == count if rate <= 50 else len(delays) > 25 * 3


def test_unusable_videos_are_named(film):
    with refused("side_by_side"):
        side_by_side([film, film[:5]], ["a", "b"])
    with pytest.raises(InputError, match="1 labels for 2"):
        side_by_side([film, film], ["a"])
    with refused("video"):
        side_by_side([film[0]], ["a"])
    with refused("video"):
        side_by_side([film * np.nan], ["a"])
