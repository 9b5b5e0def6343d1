"""Cameras, colours, and the images of the Blender process."""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image, ImageDraw
from pydantic import ValidationError

from neuma_lib.config.blender import AppearanceConfig
from neuma_lib.data.blender import worker
from neuma_lib.data.blender.appearance import colors_at, smooth_noise
from neuma_lib.data.blender.bodies import make_body
from neuma_lib.data.blender.libraries import explain_import_error
from neuma_lib.data.blender.scene import Several, Surface, render_dynamic, render_static
from neuma_lib.geometry import shapes
from neuma_lib.geometry.obstacles import obstacles
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.gltf import linear
from neuma_lib.io.images import read_image_set, read_labels
from neuma_lib.sim.colliders import Collider
from neuma_lib.splatting import viewpoints as cameras
from neuma_lib.splatting.cameras import Cameras
from tests.support.blends import needs_blender
from tests.support.errors import refused

# ------------------------------------------------------------------------------------------- cameras


def test_fifty_views_are_spread_evenly():
    directions = cameras.sphere_directions(50)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(directions.mean(axis=0), 0.0, atol=0.02)
    cosines = directions @ directions.T - 2 * np.eye(50)
    nearest = np.degrees(np.arccos(cosines.max(axis=1)))
    # 50 caps of equal area have a radius of 16.3 degrees: neighbours are about twice that apart.
    assert nearest.min() > 22 and nearest.max() < 34


def test_training_view_is_frontal():
    points = np.random.default_rng(0).uniform(0.3, 0.7, (100, 3))
    views = cameras.video_views(points, 3, 96, 96)
    np.testing.assert_allclose(views.c2w[0, :3, :3], np.eye(3), atol=1e-12)
    assert views.c2w[0, 2, 3] > 1.0
    middle, *ends = views.project(np.array([[0.5, 0.5, 0.5], [0.6, 0.5, 0.5], [0.5, 0.6, 0.5]]))[0]
    right, up = ends - middle
    assert right[0] > 0 and abs(right[1]) < 1e-9
    assert up[1] < 0 and abs(up[0]) < 1e-9


@pytest.mark.parametrize("width, height", [(96, 96), (128, 72)])
def test_framing_is_tight_and_holds_every_point(width, height):
    points = np.random.default_rng(1).normal([0.5, 0.3, 0.5], [0.05, 0.15, 0.1], (500, 3))
    views = cameras.framing(cameras.ring_directions(10), points, width, height, fill=0.9)
    reach = np.abs(views.project(points) / np.array([width / 2, height / 2]) - 1.0).max()
    np.testing.assert_allclose(reach, 0.9, atol=1e-9)


def test_projection_is_the_rasterizer_s():
    points = np.random.default_rng(2).uniform(0.3, 0.7, (50, 3))
    views = cameras.static_views(points, 7, 128, 96)
    theirs = Cameras(
        torch.from_numpy(views.viewmats), torch.from_numpy(views.K).expand(7, 3, 3), views.width, views.height
    )
    pixels, depths = theirs.project(torch.from_numpy(points))
    assert (depths > 0).all()
    np.testing.assert_allclose(pixels.numpy(), views.project(points), atol=1e-9)


# ------------------------------------------------------------------------------------------- colours


def test_noise_is_smooth_and_fills_its_range():
    points = np.random.default_rng(3).uniform(-1, 1, (20000, 3))
    values = smooth_noise(points, 0.05, seed=4)
    assert values.min() > 0.0 and values.max() < 1.0 and values.std() > 0.1
    nearby = smooth_noise(points + 1e-4, 0.05, seed=4)
    # A cubic step over a cell of 5 cm has slope 1.5; the second octave, half as wide and 3/7 as high, adds to it.
    assert np.abs(nearby - values).max() < 3**0.5 * 1e-4 * 1.5 / 0.05 * 3**0.5 * 1.3


def test_colors_name_what_is_wrong():
    mesh = shapes.build("duck", 0.3, 32)
    with refused("colors") as error:
        colors_at(mesh, mesh.vertices, AppearanceConfig(colors={"body": "#ffffff", "beek": "#000000"}))
    assert "beek" in error.value.problem
    with refused("colors"):
        colors_at(mesh, mesh.vertices, AppearanceConfig(colors={"beak": "#000000"}))
    with pytest.raises(ValidationError, match="colors.body"):
        AppearanceConfig(colors={"body": "yellow"})


def test_a_mesh_has_the_colour_of_the_body_and_ignores_parts():
    """A scene may inherit the colours of another shape."""
    mesh = shapes.place(trimesh.creation.icosphere(3), 0.3, 0.4, (0.5, 0.5))
    look = AppearanceConfig(colors={"body": "#0000ff", "wing": "#ff0000"}, contrast=0.0)
    np.testing.assert_allclose(
        colors_at(mesh, mesh.vertices, look), np.broadcast_to([0, 0, 1.0], mesh.vertices.shape)
    )
    rest = sample_volume(mesh, 3000)
    grains = make_body(mesh, AppearanceConfig(kind="grains", colors={"body": "#0000ff"}), rest[None])
    assert 0.5 * len(rest) < grains.vertices.shape[1] < len(rest)


def test_parts_have_their_colours():
    mesh = shapes.build("pawn", 0.4, 48)
    look = AppearanceConfig(colors={"body": "#0000ff", "foot": "#ff0000"}, contrast=0.0)
    colors, y = colors_at(mesh, mesh.vertices, look), mesh.vertices[:, 1]
    for part, color in ((y > y.max() - 0.05, [0, 0, 1.0]), (y < y.min() + 0.02, [1.0, 0, 0])):
        np.testing.assert_allclose(colors[part], np.broadcast_to(color, (sum(part), 3)))


def test_srgb_decodes_to_linear_light():
    np.testing.assert_allclose(linear(np.array([0.0, 0.5, 1.0])), [0.0, 0.21404, 1.0], atol=1e-5)


# ------------------------------------------------------------------------------------------- bodies


def filling(mesh, count: int, seed: int) -> np.ndarray:
    """Those of random points in the bounds that lie inside a mesh."""
    points = np.random.default_rng(seed).uniform(*mesh.bounds, (count, 3))
    return points[shapes.depth(mesh, points) > 0]


@pytest.mark.parametrize("shape, size", [("fish", 0.4), ("ball", 0.26)])
def test_grains_have_the_silhouette_of_the_body(shape, size):
    mesh = shapes.place(shape, size, 0.3, (0.5, 0.5), 48)
    points = filling(mesh, 80000, seed=5)[:30000]
    look = AppearanceConfig(kind="grains", colors={"body": "#c9a86a"})
    body = make_body(mesh, look, points[None], points[None])
    assert len(body.colors) == body.vertices.shape[1] < len(points)
    covered = [
        silhouette(body.vertices[0], axes, body.radius).sum() / silhouette(mesh.triangles, axes).sum()
        for axes in ([0, 1], [1, 2], [0, 2])
    ]
    np.testing.assert_allclose(np.mean(covered), 1.0, atol=0.01)


def silhouette(parts: np.ndarray, axes: list[int], radius: float = 0.0) -> np.ndarray:
    """Mask of what balls (N, 3) or triangles (N, 3, 3) in the unit cube cover, seen along the third axis."""
    image = Image.new("1", (1000, 1000))
    draw = ImageDraw.Draw(image)
    for part in 1000 * parts[..., axes]:
        if radius:
            draw.circle(tuple(part), 1000 * radius, fill=1)
        else:
            draw.polygon(list(map(tuple, part)), fill=1)
    return np.asarray(image)


def test_liquid_surface_is_closed_and_holds_the_volume():
    pytest.importorskip("pysplashsurf")
    import trimesh

    mesh = shapes.place("bottle", 0.4, 0.42, (0.5, 0.5), 48)
    points = filling(mesh, 30000, seed=6)
    look = AppearanceConfig(kind="liquid", colors={"body": "#d98f24"})
    body = make_body(mesh, look, points[None], points[None])
    vertices, faces, colors = body.surfaces[0]
    surface = trimesh.Trimesh(vertices, faces, process=False)
    assert surface.is_watertight and len(colors) == len(vertices)
    np.testing.assert_allclose(surface.volume, mesh.volume, rtol=0.03)


# ------------------------------------------------------------------------------------------- Blender


def ball(size: int):
    """A ball and two views of it."""
    mesh = shapes.place("ball", 0.26, 0.3, (0.5, 0.5), 48)
    colors = colors_at(mesh, mesh.vertices, AppearanceConfig(colors={"body": "#f4c534"}, accent="#3060c0"))
    body = Surface(mesh.vertices[None], mesh.faces, colors)
    return body, cameras.static_views(body.points, 2, size, size)


def test_missing_libraries_are_named_with_their_packages():
    text = "ImportError: libXi.so.6: cannot open shared object file: No such file or directory"
    assert (
        "libXi.so.6" in explain_import_error(text).problem and "libxi6" in explain_import_error(text).remedy
    )
    assert "Python 3.11" in explain_import_error("ModuleNotFoundError: No module named 'bpy'").problem
    assert explain_import_error("Segmentation fault") is None


def test_failing_import_reaches_the_user(tmp_path, monkeypatch):
    """A bpy that cannot load its libraries, in the real process."""
    broken = tmp_path / "modules"
    broken.mkdir()
    (broken / "bpy.py").write_text(
        "raise ImportError('libSM.so.6: cannot open shared object file: No such file')"
    )
    monkeypatch.setenv("PYTHONPATH", str(broken))
    body = Surface(np.full((1, 1, 3), 0.5), np.zeros((0, 3), int), np.ones((1, 3)), 0.1)
    views = cameras.framing(cameras.ring_directions(1), np.array([[0.4] * 3, [0.6] * 3]), 16, 16)
    with refused("Blender") as error:
        render_static(body, views, tmp_path / "out", 4)
    assert "libsm6" in error.value.remedy
    assert list((tmp_path / "out").iterdir()) == []


def test_blender_may_have_another_python(tmp_path, monkeypatch):
    """It is started with the project alone on its path, and must exist."""
    other = tmp_path / "python"
    other.write_text(f'#!/bin/sh\necho "$PYTHONPATH|$*" > {tmp_path}/seen\nexit 1\n')
    other.chmod(0o755)
    body, views = ball(16)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "packages"))
    monkeypatch.setenv("NEUMA_BLENDER_PYTHON", str(other))
    with pytest.raises(RuntimeError, match="status 1"):
        render_static(body, views, tmp_path / "out", 4)
    path, words = (tmp_path / "seen").read_text().split("|")
    assert (Path(path) / "neuma_lib").is_dir() and words.startswith("-m neuma_lib.data.blender.worker ")
    monkeypatch.setenv("NEUMA_BLENDER_PYTHON", str(tmp_path / "none"))
    with refused("NEUMA_BLENDER_PYTHON=", "none"):
        render_static(body, views, tmp_path / "out", 4)


@needs_blender
def test_renders_agree_with_the_cameras(tmp_path):
    """Centroids of small balls at known points, against their projections: 0.1 px."""
    points = np.array(
        [[0.5, 0.5, 0.5], [0.3, 0.62, 0.45], [0.68, 0.4, 0.6], [0.36, 0.33, 0.62], [0.62, 0.7, 0.36]]
    )
    body = Surface(points[None], np.zeros((0, 3), int), np.ones((5, 3)), 0.012)
    corners = np.array([[0.25] * 3, [0.75] * 3])
    views = cameras.framing(cameras.ring_directions(4)[[0, 1, 3]], corners, 144, 128, fill=1.0)
    render_static(body, views, tmp_path, 64)
    images = read_image_set(tmp_path / "transforms.json")
    np.testing.assert_allclose(images.viewmats, views.viewmats, atol=1e-9)
    np.testing.assert_allclose(images.Ks[0], views.K, atol=1e-9)
    row, column = np.mgrid[:128, :144] + 0.5
    pixels = np.stack([column, row], axis=-1)
    checked = 0
    for alpha, expected in zip(images.images[..., 3], views.project(points), strict=True):
        for k, centre in enumerate(expected):
            if np.linalg.norm(np.delete(expected, k, axis=0) - centre, axis=1).min() < 14:
                continue
            weight = alpha * (np.linalg.norm(pixels - centre, axis=-1) < 7)
            centroid = (weight[..., None] * pixels).sum(axis=(0, 1)) / weight.sum()
            np.testing.assert_allclose(centroid, centre, atol=0.1)
            checked += 1
    assert checked >= 12


@needs_blender
def test_same_job_same_bytes_and_moving_mesh(tmp_path):
    mesh = shapes.place("ball", 0.08, 0.4, (0.5, 0.5), 40)
    colors = colors_at(mesh, mesh.vertices, AppearanceConfig(colors={"body": "#f4c534"}))
    moved = np.stack([mesh.vertices, mesh.vertices + [0.05, -0.1, 0.0]])
    body = Surface(moved, mesh.faces, colors)
    views = cameras.video_views(body.points, 2, 48, 48)
    done = []
    (tmp_path / "b" / ".render-abandoned").mkdir(parents=True)
    for folder in ("a", "b"):
        render_dynamic(
            body, views, [0, 8], 1e-3, tmp_path / folder, 4, progress=lambda *count: done.append(count)
        )
    assert done == [(k, 4) for k in (1, 2, 3, 4)] * 2
    names = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert names == ["d_0_0000.png", "d_0_0008.png", "d_1_0000.png", "d_1_0008.png", "transforms.json"]
    assert names == sorted(p.name for p in (tmp_path / "b").iterdir())
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    images = read_image_set(tmp_path / "a" / "transforms.json")
    first = np.flatnonzero(images.views == 0)
    assert images.steps[first].tolist() == [0, 8]
    row, column = np.mgrid[:48, :48] + 0.5
    alpha = images.images[first, :, :, 3]
    middle = np.stack([(alpha * m).sum(axis=(1, 2)) / alpha.sum(axis=(1, 2)) for m in (column, row)], axis=1)
    np.testing.assert_allclose(middle, views.project(moved.mean(axis=1))[0], atol=0.15)
    times = [f["time"] for f in json.loads((tmp_path / "a" / "transforms.json").read_text())["frames"]]
    assert times == [0.0, 0.0, 0.008, 0.008]


@needs_blender
@pytest.mark.skipif(torch.cuda.is_available(), reason="for machines without a GPU")
def test_without_a_gpu_auto_is_the_cpu_and_cuda_an_error(tmp_path):
    body, views = ball(32)
    for device in ("cpu", "auto"):
        render_static(body, views, tmp_path / device, 4, device=device)
    for name in ("s_000.png", "s_001.png"):
        assert (tmp_path / "cpu" / name).read_bytes() == (tmp_path / "auto" / name).read_bytes()
    with refused("dataset.blender.device"):
        render_static(body, views, tmp_path / "cuda", 4, device="cuda")
    assert list((tmp_path / "cuda").iterdir()) == []


DEVICE_OF = """
import ctypes, sys, types, bpy
from cycles.properties import CyclesPreferences
from neuma_lib.data.blender import cycles
CyclesPreferences.get_devices_for_type = lambda self, kind: [types.SimpleNamespace(type=kind, use=False)]
CyclesPreferences.compute_device_type = ""


def driver(name):
    if sys.argv[1] == "unknown":
        raise OSError(name)
    numbers = dict(zip((75, 76), map(int, sys.argv[1])))

    def attribute(out, which, device):
        out._obj.value = numbers[which]
        return 0

    return types.SimpleNamespace(cuInit=lambda flags: 0, cuDeviceGetAttribute=attribute)


cycles.ctypes = types.SimpleNamespace(CDLL=driver, c_int=ctypes.c_int, byref=ctypes.byref)
cycles.start(8, 8, 1, 1, sys.argv[2])
print(bpy.context.scene.cycles.device)
"""


@needs_blender
@pytest.mark.parametrize(
    ("capability", "device", "used"),
    [
        ("86", "cuda", "GPU"),
        ("unknown", "cuda", "GPU"),
        ("86", "auto", "GPU"),
        ("90", "auto", "CPU"),
        ("90", "cuda", None),
    ],
)
def test_a_gpu_needs_machine_code(capability, device, used):
    """The driver of an H200 (compute capability 9.0) compiles Cycles for more than 400 s without any output."""
    run = subprocess.run(
        [sys.executable, "-c", DEVICE_OF, capability, device], capture_output=True, text=True
    )
    assert run.stdout.split()[-1:] == ([used] if used else []), run.stderr
    assert (
        "InputError: dataset.blender.device: is cuda, but Blender has no kernel_sm_90.cubin" in run.stderr
    ) == (used is None)


@needs_blender
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
def test_a_gpu_renders_what_the_cpu_does(tmp_path):
    body, views = ball(128)
    images = []
    for device in ("cpu", "cuda"):
        render_static(body, views, tmp_path / device, 16, device=device)
        images.append(read_image_set(tmp_path / device / "transforms.json").images)
    assert np.abs(images[0] - images[1]).mean() < 1 / 255


@needs_blender
def test_colours_on_the_image_are_those_of_the_surface(tmp_path):
    """Matt, mostly ambient light: a flat colour stays near itself, wherever the surface turns."""
    mesh = shapes.place("ball", 0.26, 0.3, (0.5, 0.5), 48)
    gray = np.full((len(mesh.vertices), 3), 0.6)
    body = Surface(mesh.vertices[None], mesh.faces, gray)
    render_static(body, cameras.static_views(body.points, 6, 48, 48), tmp_path, 8)
    pictures = read_image_set(tmp_path / "transforms.json").images / 255.0
    inside = pictures[pictures[..., 3] == 1.0]
    assert np.abs(inside[:, :3] - 0.6).max() < 0.12


def test_locks_are_in_a_folder_of_the_user(tmp_path, monkeypatch):
    """A link with the name of a lock is not followed, and the temporary folder is not used."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, cores: None)
    for lock in worker.claim_cores(1):
        lock.close()
    (made,) = (tmp_path / "cache").rglob("*.lock")
    folder = made.parent
    assert folder.stat().st_mode & 0o777 == 0o700 and made.stat().st_mode & 0o777 == 0o600
    made.unlink()
    made.symlink_to(tmp_path / "target")
    with pytest.raises(OSError):
        worker.own_lock(made.stem)
    assert not (tmp_path / "target").exists()


@needs_blender
def test_a_moving_obstacle_hides_the_body_in_its_mask(tmp_path):
    """A wall in front of the left half of a ball, later of all of it, and far away at the end. The projection of its
    edge is the border of the mask within 1 px: half a pixel of the border, and half of antialiasing.
    """
    body, _ = ball(64)
    body = Surface(np.repeat(body.vertices, 3, axis=0), body.faces, body.colors)
    views = cameras.video_views(body.points, 1, 64, 64)
    collider = Collider("box", (0.2, 0.3, 0.01), (0.3, 0.3, 0.7), velocity=(0.2, 0.0, 0.0))
    around = obstacles([collider], [0.0, 1.0, 10.0])
    render_dynamic(body, views, [0, 1, 10], 1.0, tmp_path / "a", 8, obstacles=around)
    render_dynamic(body, views, [0, 1, 10], 1.0, tmp_path / "b", 8)
    images, alone = (read_image_set(tmp_path / name / "transforms.json") for name in ("a", "b"))
    assert images.steps.tolist() == [0, 10] and alone.steps.tolist() == [0, 1, 10]  # without a hidden frame
    edge = views.project(np.array([[0.5, 0.3, 0.71]]))[0, 0, 0]
    (half, seen), (whole, _, last) = images.images, alone.images
    np.testing.assert_array_equal(seen[..., 3], last[..., 3])
    column = np.arange(64) + 0.5
    assert not half[:, column < edge - 1, 3].any()
    beyond = column > edge + 1
    np.testing.assert_array_equal(half[:, beyond, 3], whole[:, beyond, 3])
    opaque = beyond & (whole[..., 3] == 255)
    # The denoiser, which sees the wall, changes colours by 0.4 of 255. A shadow of the wall would change them by 3.4.
    assert np.abs(half[opaque].astype(int) - whole[opaque]).mean() < 2
    # the colours show the wall, which is grey and darker than the white behind it
    wall = half[32, int(edge) - 8, :3].astype(int)
    assert np.ptp(wall) < 40 and wall.max() < 200 and (half[0, -1, :3] == 255).all()


@needs_blender
def test_labels_are_the_visible_objects(tmp_path):
    """Of two squares, the front one covers the lower half of the other. Borders are where their edges project."""

    def square(y, z):
        corners = [(0.4, y), (0.6, y), (0.6, y + 0.2), (0.4, y + 0.2)]
        vertices = np.array([(x, y, z) for x, y in corners])
        return Surface(vertices[None], np.array([[0, 1, 2], [0, 2, 3]]), np.full((4, 3), 0.5))

    pile = Several([square(0.4, 0.4), square(0.3, 0.6)])
    views = cameras.video_views(pile.points, 1, 64, 64)
    render_dynamic(pile, views, [0], 1.0, tmp_path, 8)
    (labels,) = read_labels(tmp_path / "transforms.json")
    mask = read_image_set(tmp_path / "transforms.json").images[0, ..., 3]
    np.testing.assert_array_equal(labels > 0, mask > 127)
    column = int(views.project(np.array([[0.5, 0.5, 0.5]]))[0, 0, 0])
    heights = [((0.5, 0.6, 0.4), 0, 1), ((0.5, 0.5, 0.6), 1, 2), ((0.5, 0.3, 0.6), 2, 0)]
    for edge, above, below in heights:
        row = views.project(np.array([edge]))[0, 0, 1]
        assert labels[int(row - 1.5), column] == above and labels[int(row + 1.5), column] == below
    render_dynamic(pile.bodies[0], views, [0], 1.0, tmp_path / "one", 8)
    assert not (tmp_path / "one" / "labels").exists()
    with refused("frame 0", problem="label_path"):
        read_labels(tmp_path / "one" / "transforms.json")
