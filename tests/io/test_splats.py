"""Splats of other programs: formats, removal of what is not the object, surface, motion under laws."""

import dataclasses
import gzip
import math
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.splat_surface import between, bowl, drawn_on
from neuma_lib.config.geometry import SurfaceConfig
from neuma_lib.coupling.deformation import arms_at_rest, deform
from neuma_lib.coupling.nearest_binding import ENOUGH, bind_nearest
from neuma_lib.errors import InputError
from neuma_lib.geometry.depth_fusion import REACH
from neuma_lib.geometry.splat_surface import opacity_and_depth, splat_surface, views_around
from neuma_lib.geometry.volume import inside
from neuma_lib.io.compressed_splats import save_compressed
from neuma_lib.io.gaussians import save_gaussians
from neuma_lib.io.ply import read_ply, write_ply
from neuma_lib.io.splats import load_splat
from neuma_lib.project import cases
from neuma_lib.project.find import scene_files
from neuma_lib.project.loading import load, merged, read_yaml
from neuma_lib.splatting import culling
from neuma_lib.splatting.cameras import Cameras, look_at
from neuma_lib.splatting.gaussians import quaternions, rotations
from neuma_lib.splatting.spherical_harmonics import colours, rotated
from tests.support.errors import refused
from tests.support.splat_files import ball, write_compressed, write_splat, write_spz

ROOT = Path(__file__).resolve().parents[2]
RULES = {"min_opacity": 0.1, "max_scale": 0.1, "reach": 3.0, "min_links": 4, "count": 10**9}


def angles(a, b):
    """Angles between rotations of quaternions [rad]."""
    return 2 * (a * b).sum(dim=1).abs().clamp(max=1).arccos()


def assert_close(read, expected, mean, scale, angle, opacity, sh0, shN=0.0):
    """Absolute errors, that of scales relative."""
    assert (read.means - expected.means).abs().max() <= mean
    assert (read.scales.log() - expected.scales.log()).abs().max() <= scale
    assert angles(read.quats.double(), expected.quats.double()).max() <= angle
    assert (read.opacities - expected.opacities).abs().max() <= opacity
    assert (read.sh0 - expected.sh0).abs().max() <= sh0
    assert read.shN.shape == expected.shN.shape
    assert expected.shN.numel() == 0 or (read.shN - expected.shN).abs().max() <= shN


HALF = 0.5 * (1 + 1e-3)  # of a level of a quantised value, and what is lost in float32


def angle_of(error, largest=0.71):
    """Angle [rad] by which a rotation is off whose three smaller components have an error each.

    The largest component, at least 1/2, follows: its error is at most sum |q_i| e / q_max <= 3 e q / (1/2) with q at
    most `largest`; the angle is twice the distance of the quaternions, to first order.
    """
    return 1.1 * 2 * math.hypot(*(error,) * 3, 3 * error * largest / 0.5)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_the_layout_of_the_3dgs_release_is_read(tmp_path, degree):
    expected = ball(degree=degree)
    save_gaussians(tmp_path / "a.ply", expected)
    assert_close(load_splat(tmp_path / "a.ply"), expected, 0, 1e-6, 2e-3, 1e-6, 0, 1e-9)


@pytest.mark.parametrize("writer", ["theirs", "old", "ours"])
@pytest.mark.parametrize("degree", [0, 2])
def test_compressed_ply_is_read_and_written_to_its_own_precision(tmp_path, writer, degree):
    """600 Gaussians are three chunks, the last one of 88; ranges of means are at most 2."""
    expected = ball(degree=degree)
    if writer == "ours":
        save_compressed(tmp_path / "a.ply", expected, order=np.arange(len(expected)))
    else:
        if writer == "old":  # colours are in [0, 1] there
            expected = dataclasses.replace(expected, sh0=expected.sh0.clamp(-1.7, 1.7))
        write_compressed(tmp_path / "a.ply", expected, old=writer == "old")
    colour = HALF / 255 * (1.0 if writer == "old" else 3.0 * 0.2820948) / 0.2820948
    bounds = (HALF * 2 / 1023, HALF * math.log(2) / 1023, angle_of(HALF * math.sqrt(2) / 1023))
    assert_close(load_splat(tmp_path / "a.ply"), expected, *bounds, HALF / 255, colour, HALF * 8 / 255)


def test_compressed_ply_is_ordered_in_space_so_that_chunks_are_small(tmp_path):
    expected = ball(count=4096)
    curve, unordered = culling.morton_order(expected.means.double().numpy()), np.arange(len(expected))
    errors = []
    for order, written_order in ((None, curve), (unordered, unordered)):
        save_compressed(tmp_path / "a.ply", expected, order=order)
        errors.append((load_splat(tmp_path / "a.ply").means - expected.means[written_order]).square().mean())
    assert errors[0] < errors[1] / 2  # boxes of half the ball's width: 1/4, and some chunks lie in two


def test_splat_files_are_read(tmp_path):
    expected = ball()
    write_splat(tmp_path / "a.splat", expected)
    # bytes of all four components, and 1.0 is 255/128 - 1: an error of a whole level; then normalised
    bounds = (1e-7, 1e-6, 1.1 * 2 * math.hypot(*(2 * HALF / 128,) * 4), HALF / 255, HALF / 255 / 0.2820948)
    assert_close(load_splat(tmp_path / "a.splat"), expected, *bounds)


@pytest.mark.parametrize("version, degree", [(1, 0), (1, 3), (2, 1), (3, 0), (3, 3)])
def test_spz_is_read(tmp_path, version, degree):
    """Positions have 12 fractional bits, or are half floats, 11 bits of at most 1; logarithms of scales 1/16."""
    expected = ball(degree=degree)
    if version < 3:  # w is what x, y, z leave, and ill-determined near zero
        w = expected.quats[:, :1].abs().clamp(min=0.5)
        xyz = torch.nn.functional.normalize(expected.quats[:, 1:], dim=1) * (1 - w * w).sqrt()
        expected = dataclasses.replace(expected, quats=torch.cat([w, xyz], dim=1))
    write_spz(tmp_path / "a.spz", expected, version=version, degree=degree)
    angle = angle_of(HALF * math.sqrt(0.5) / 511) if version == 3 else angle_of(HALF / 127.5, 1.0)
    bounds = (2.0**-11 if version == 1 else HALF * 2.0**-12, HALF / 16, angle)
    assert_close(load_splat(tmp_path / "a.spz"), expected, *bounds, HALF / 255, HALF / 255 / 0.15, HALF / 128)


def cut(data):
    return data[:-5]


def written(writer, change=lambda data: data, gaussians=None, **options):
    """A function of a path that writes a splat and changes its bytes."""

    def write(path):
        writer(path, ball(40) if gaussians is None else gaussians, **options)
        path.write_bytes(change(path.read_bytes()))

    return write


WITH_NAN = dataclasses.replace(ball(40), means=ball(40).means.index_fill(0, torch.tensor([7]), math.nan))


def with_log_scale(path, value):
    """A Gaussian whose scale is 0 or infinite in single precision."""
    save_gaussians(path, ball(40))
    rows, _ = read_ply(path)
    rows["scale_0"][7] = value
    write_ply(path, rows)


FLAT = dataclasses.replace(ball(40), scales=ball(40).scales.index_fill(0, torch.tensor([7]), 0.0))
ZEROS = gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 3, 2**20, 0, 12, 0, 0) + bytes(20 * 2**20), mtime=0)
"""A million Gaussians in 20 kB."""
POINTS = b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("a.obj", b"v 0 0 0\n", "must end in"),
        ("a.splat", written(write_splat, cut), "multiple of 32"),
        ("a.splat", written(write_splat, gaussians=WITH_NAN), "Gaussian 7 is not finite"),
        ("a.splat", written(write_splat, gaussians=FLAT), "scale of Gaussian 7 is not positive"),
        ("a.ply", lambda path: with_log_scale(path, -200), "scale of Gaussian 7 is not positive"),
        ("a.ply", lambda path: with_log_scale(path, 200), "scales of Gaussian 7 is not finite"),
        ("a.spz", written(lambda path, g: path.write_bytes(ZEROS)), "too many for"),
        ("a.splat", b"", "no Gaussians"),
        ("a.spz", written(write_spz, lambda data: data[:-40]), "ends after"),
        ("a.spz", written(write_spz, count=2**31), "claims"),
        ("a.spz", written(write_spz, gaussians=ball(40, degree=1), degree=1, flags=2), "no extensions"),
        ("a.spz", struct.pack("<II", 0x5053474E, 4) + bytes(60), "version 4"),
        ("a.spz", gzip.compress(bytes(200), mtime=0), "NGSP"),
        ("a.spz", b"no gzip at all", "header"),
        ("a.ply", written(write_compressed, cut), "claims"),
        (
            "a.ply",
            written(write_compressed, lambda data: data.replace(b"scale_y", b"scale_w")),
            "min_scale_y",
        ),
        ("a.ply", POINTS, "has no property"),
    ],
)
def test_bad_files_are_named(tmp_path, name, content, problem):
    path = tmp_path / name
    path.write_bytes(content) if isinstance(content, bytes) else content(path)
    with refused(path, problem=problem):
        load_splat(path)


def test_missing_file():
    with refused("nowhere.spz"):
        load_splat("nowhere.spz")


def test_an_spz_that_unpacks_to_more_than_its_header_claims_takes_no_more_memory(tmp_path, monkeypatch):
    """A bomb: 64 MiB of zeros behind the header of three Gaussians."""
    header = struct.pack("<IIIBBBB", 0x5053474E, 3, 3, 0, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(header + b"\x80" * 60 + bytes(2**26)))
    limits = []
    real = zlib.decompressobj

    class Watched:
        def __init__(self, *arguments):
            self.stream = real(*arguments)

        def decompress(self, data, limit):
            limits.append(limit)
            return self.stream.decompress(data, limit)

        unconsumed_tail = property(lambda self: self.stream.unconsumed_tail)

    monkeypatch.setattr(zlib, "decompressobj", Watched)
    assert len(load_splat(tmp_path / "a.spz")) == 3
    assert sum(limits) == 16 + 3 * 20


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_turned_harmonics_look_the_same_along_turned_directions(degree):
    g = ball(50, degree=degree)
    R = rotations(torch.randn(50, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))
    directions = torch.nn.functional.normalize(g.means.double() + 0.1, dim=1)
    sh = g.sh().double()
    seen = colours(rotated(sh, R), torch.einsum("gij,gj->gi", R, directions))
    torch.testing.assert_close(seen, colours(sh, directions), atol=1e-12, rtol=0)


def test_quaternions_undo_rotations():
    q = torch.randn(1000, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    q[:8] = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]).repeat(2, 1)
    recovered = quaternions(rotations(q))
    torch.testing.assert_close(rotations(recovered), rotations(q), atol=1e-14, rtol=0)
    assert (recovered[:, 0] >= 0).all()


@pytest.mark.parametrize("up", culling.UP)
@pytest.mark.parametrize("turn", [0.0, 33.0])
def test_what_is_up_in_the_file_points_up(up, turn):
    R = culling.upright(up, turn).numpy()
    np.testing.assert_allclose(R @ culling.UP[up], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(R) > 0
    about = R @ culling.upright(up, 0.0).numpy().T
    np.testing.assert_allclose(
        about @ [0, 0, 1], [math.sin(math.radians(turn)), 0, math.cos(math.radians(turn))]
    )


def test_a_turned_splat_has_turned_covariances_and_a_placed_one_its_size():
    g, R = ball(100, degree=1), culling.upright("z", 20.0)
    turned = culling.turned(g, R)
    R = R.float()
    torch.testing.assert_close(turned.covars(), R @ g.covars() @ R.T, atol=1e-7, rtol=1e-4)
    there = culling.placed(turned, 0.4, 0.3, (0.5, 0.6))
    low, high = there.means.amin(0), there.means.amax(0)
    torch.testing.assert_close((low + high) / 2, torch.tensor([0.5, 0.3, 0.6]), atol=1e-6, rtol=0)
    assert float((high - low).max()) == pytest.approx(0.4, rel=1e-5)
    factor = there.scales / turned.scales
    assert float((factor - factor[0, 0]).abs().max()) < 1e-6


def test_faint_oversized_and_isolated_gaussians_are_left_out():
    """A ball with a haze, a backdrop, three strays, and a separate smaller ball."""
    body, separate = ball(800), ball(60, radius=0.2, seed=1, centre=(3.0, 0.0, 0.0))
    haze, backdrop, strays = ball(50, seed=2), ball(5, seed=3), ball(3, radius=8.0, seed=4)
    haze = dataclasses.replace(haze, opacities=haze.opacities * 0.1)
    backdrop = dataclasses.replace(backdrop, scales=torch.full_like(backdrop.scales, 1.0))
    strays = dataclasses.replace(strays, means=strays.means * 4, scales=strays.scales * 0.01)
    parts = [haze, separate, strays, body, backdrop]
    together = type(body)(*(torch.cat([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(body)))
    kept, counts = culling.culled(together, **RULES)
    assert dataclasses.asdict(counts) == {
        "read": 918, "faint": 50, "oversized": 5, "isolated": 63, "kept": 800
    }  # fmt: skip
    torch.testing.assert_close(kept.means, body.means)


@pytest.mark.parametrize(
    "change", [{"min_opacity": 0.99}, {"max_scale": 1e-6}, {"reach": 1e-9}], ids=lambda change: next(iter(change))
)  # fmt: skip
def test_a_splat_of_which_nothing_is_left_is_refused(change):
    g = dataclasses.replace(ball(100), scales=torch.full((100, 3), 1e-5))
    with refused(f"splat.{next(iter(change))}"):
        culling.culled(g, **{**RULES, **change})


def test_thinned_gaussians_are_spread_evenly_and_fill_the_same_space():
    g = ball(8000)
    thin = culling.thinned(g, 1000, seed=3)
    assert len(thin) == 1000
    # each is one of the old ones, twice as large
    old = {tuple(mean): scale for mean, scale in zip(g.means.tolist(), g.scales, strict=True)}
    for mean, scale in zip(thin.means.tolist(), thin.scales, strict=True):
        torch.testing.assert_close(scale, 2 * old[tuple(mean)])
    # an even draw: each octant has its eighth, within four deviations of an independent draw
    octants = np.bincount(((thin.means > 0).long() @ torch.tensor([1, 2, 4])).numpy(), minlength=8)
    share = np.bincount(((g.means > 0).long() @ torch.tensor([1, 2, 4])).numpy(), minlength=8) / 8
    assert np.abs(octants - share).max() < 4 * math.sqrt(125 * 7 / 8) / 2
    assert torch.equal(culling.thinned(g, 1000, seed=3).means, thin.means)
    assert not torch.equal(culling.thinned(g, 1000, seed=4).means, thin.means)
    assert culling.thinned(g, 8000) is g


def test_the_surface_of_a_ball_of_gaussians():
    """Its silhouette is where half of the light is absorbed, within a spacing of the outermost centres."""
    g = culling.placed(ball(3000), 0.3, 0.5, (0.5, 0.5))
    mesh = splat_surface(g, views_around(g, 24, 128), SurfaceConfig(resolution=48))
    spacing = 0.15 * (4 * math.pi / 3 / 3000) ** (1 / 3)
    assert mesh.is_watertight
    low, high = (4 / 3 * math.pi * (0.15 + k * spacing) ** 3 for k in (-1, 1))
    assert low < mesh.volume < high
    assert np.abs(mesh.centroid - 0.5).max() < spacing


def test_depth_shows_the_inside_of_a_bowl_which_no_silhouette_shows():
    truth = bowl()
    assert truth.is_watertight and truth.volume > 0
    g, spacing = drawn_on(truth, 3000)
    mesh = splat_surface(g, views_around(g, 24, 128), SurfaceConfig(resolution=40))
    assert mesh.is_watertight
    distance = between(mesh, truth)
    assert distance.mean() < spacing and np.quantile(distance, 0.95) < 2 * spacing
    content, bottom = [0.5, 0.5, 0.5], [0.5, 0.415, 0.5]
    for each in (truth, mesh):
        assert inside(each, np.array([content, bottom])).tolist() == [False, True]


@pytest.mark.parametrize("gap", [0.005, 0.3])
def test_a_pixel_that_looks_partly_through_a_gap_has_no_depth(gap):
    """Half transparent discs before opaque ones: nearly one surface, or two, whose mean would lie where nothing is."""
    eye, target, up = (torch.tensor(v) for v in ([[0.0, 0.0, 2.0]], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    K = torch.tensor([[[64.0, 0.0, 16.0], [0.0, 64.0, 16.0], [0.0, 0.0, 1.0]]])
    sides = [[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]]  # so that the splat is 1 m wide
    g = dataclasses.replace(
        ball(4),
        means=torch.tensor([[0.0, 0.0, gap], [0.0, 0.0, 0.0], *sides]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(4, 1),
        scales=torch.tensor([[0.2, 0.2, 1e-3]] * 2 + [[1e-3] * 3] * 2),
        opacities=torch.tensor([0.5, 0.99, 0.9, 0.9]),
    )
    _, depths = opacity_and_depth(g, Cameras(look_at(eye, target, up), K, 32, 32), 0.5)
    middle = depths[0, 16, 16]
    if gap > 2 * REACH:
        assert middle.isnan()
    else:
        assert 2 - gap < middle < 2


def test_gaussians_without_particles_follow_the_nearest_affinely():
    """No particle is added, and an affine motion of the particles is that of all Gaussians, also of those outside."""
    g = ball(500).to(dtype=torch.float64)
    g = dataclasses.replace(g, scales=g.scales * torch.linspace(0.01, 3, 500, dtype=torch.float64)[:, None])
    x0 = 0.8 * ball(300, seed=5).means.double()
    binding = bind_nearest(g.means, g.covars(), x0)
    assert binding.shape == (500, 300) and (binding.values >= 0).all()
    assert (binding.counts >= ENOUGH).all()
    rows = torch.repeat_interleave(torch.arange(500), binding.counts)
    sums = torch.zeros(500, dtype=torch.float64).index_add_(0, rows, binding.values)
    torch.testing.assert_close(sums, torch.ones(500, dtype=torch.float64))
    A = torch.tensor([[1.1, 0.3, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.2, 1.2]], dtype=torch.float64)
    b = torch.tensor([0.1, -0.4, 0.2], dtype=torch.float64)
    arms = arms_at_rest(g.means, binding, x0)
    state = (x0 @ A.T + b)[None], A.expand(1, 300, 3, 3).contiguous()
    means, covars = deform(g.means, g.covars(), binding, x0, *state, arms=arms)
    torch.testing.assert_close(means[0], g.means @ A.T + b, atol=1e-12, rtol=0)
    torch.testing.assert_close(covars[0], A @ g.covars() @ A.T, atol=1e-12, rtol=1e-9)
    with refused("binding: particles"):
        bind_nearest(g.means, g.covars(), x0[:10])


def settings(changes):
    """The default settings with changes."""
    return load(merged(read_yaml(ROOT / "config/config.yaml"), changes), ROOT)


def test_a_scene_needs_only_its_file():
    config = settings({"scenes": {"Guitar": {"splat": "guitar.ply"}}})
    scene = config.scenes["Guitar"]
    assert scene.splat.file == "guitar.ply" and scene.law is None and not scene.has_truth
    assert (scene.size, scene.height, scene.velocity, scene.steps) == (0.4, 0.5, (0.0, 0.0, 0.0), 1000)
    assert "Guitar" not in config.plain_scenes


def test_a_law_moves_a_splat_in_the_step_that_it_was_learned_with():
    scenes = {"Guitar": {"splat": "guitar.ply", "dt": 5e-4, "steps": 640}}
    config = settings({"scenes": scenes, "dataset": {"frames": None, "stride": 64}})
    own = tuple(range(0, 641, 64))
    assert cases.motion_clock(config, "Guitar", "nclaw") == (5e-4, own)
    dt, frames = cases.motion_clock(config, "Guitar", "neuma+law_from=BouncyBall")
    assert dt == config.scenes["BouncyBall"].dt == 1e-3
    assert frames == tuple(step // 2 for step in own)


def test_a_viewer_shows_a_splat_under_laws_from_elsewhere():
    config = settings({"scenes": {"Guitar": {"splat": "guitar.ply", "dt": 2e-4}}})
    requested = ["nclaw", "neuma", "constants+law_from=ClayCat"]
    learned = [f"neuma+law_from={scene}" for scene in config.figures.i23d]
    moving = cases.moving_methods(config, "Guitar", requested)
    assert moving == ["nclaw", *learned, "constants+law_from=ClayCat"] and len(learned) > 1
    assert cases.moving_methods(config, "ClayCat", requested) == requested
    with pytest.raises(InputError, match="Guitar/spring_gaus: a splat has no video"):
        cases.moving_methods(config, "Guitar", ["spring_gaus"])
    files = scene_files(config, "Guitar", moving)
    assert files.truth is files.transforms is None
    assert {run.gaussian_motion for run in files.runs} == {"affine"}
    own, other = files.runs[0].law.dt, files.runs[-1].law.dt
    assert (own, other) == (config.scenes["Guitar"].dt, config.scenes["ClayCat"].dt) and own != other


@pytest.mark.parametrize(
    "scene, where",
    [
        ({"splat": {"up": "z"}}, "splat.file"),
        ({"splat": {"file": "a.ply", "up": "north"}}, "splat.up"),
        ({"splat": {"file": "a.ply", "opacity": 1}}, "opacity"),
        ({"splat": "a.ply", "steps": None}, "steps"),
        ({"splat": "a.ply", "velocity": None}, "velocity"),
        ({"shape": "ball"}, "law"),
    ],
)
def test_mistakes_in_the_settings_are_named(scene, where):
    with pytest.raises(InputError, match=where):
        settings({"scenes": {"Guitar": scene}})
