"""Motions for other programs, made by the workflow and read by other readers: of springs, of an experiment with another
body, and of several bodies."""

import json
import struct

import imageio.v2 as imageio
import numpy as np
import pytest
import trimesh
from PIL import Image, ImageSequence
from plyfile import PlyData

from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.splats import load_splat
from tests.support.blends import read_blend
from tests.support.full_run import EXPORTED, SPRINGS, USD
from tests.support.project import SCENE

MARGIN = 0.05
"""Gaussians and surface lie at most this far from the box of the particles [m]; these are about 0.02 m apart."""


@pytest.fixture(params=EXPORTED, ids=["springs", "experiment", "bodies"])
def moved(full, request):
    """Its export folder, its bodies, positions (T, N, 3) [m] and times (T,) [s]."""
    folder = full.root / request.param
    path, attributes = read_arrays(folder / "rollout.h5")
    assert len(path["x"]) == len(path["frames"]) > 5
    return folder / "export", EXPORTED[request.param], path["x"], path["frames"] * attributes["dt"]


def assert_around(points, x):
    """Points (n, 3) and particles (N, 3) fill the same box."""
    for end in (np.min, np.max):
        np.testing.assert_allclose(end(points, axis=0), end(x, axis=0), atol=MARGIN)


def test_particles(moved):
    folder, _, x, time = moved
    together, _ = read_arrays(folder / "particles.h5")
    np.testing.assert_array_equal(together["x"], x)
    np.testing.assert_allclose(together["time"], time, rtol=1e-6)
    assert together["mass"].shape == together["vol0"].shape == (x.shape[1],) and together["mass"].min() > 0
    files = sorted(folder.glob("particles/*.ply"))
    assert [file.stem for file in files] == [f"{k:04d}" for k in range(len(x))]
    for file, positions in zip(files, x, strict=True):
        rows = PlyData.read(file)["vertex"]
        np.testing.assert_array_equal(np.stack([rows[axis] for axis in "xyz"], axis=1), positions)
        assert np.isfinite(rows["volume_ratio"]).all()


def test_gaussians_plain_and_compressed(moved):
    folder, _, x, _ = moved
    plain, packed = (sorted(folder.glob(f"{name}/*.ply")) for name in ("gaussians", "compressed"))
    assert len(plain) == len(packed) == len(x)
    for k in (0, len(x) - 1):
        rows = PlyData.read(plain[k])["vertex"]
        means = np.stack([rows[axis] for axis in "xyz"], axis=1)
        assert_around(means, x[k])
        loaded = load_splat(packed[k])
        ranges = np.ptp(means, axis=0) / 1023
        assert len(loaded) == len(means)
        nearest = np.linalg.norm((loaded.means.numpy()[:, None] - means) / ranges, axis=2).min(axis=1)
        assert nearest.max() < 1.0  # half a step in each of three directions
        assert loaded.scales.min() > 0 and np.isfinite(loaded.sh().numpy()).all()


def shown(file):
    """Vertices (T, n, 3) of a .glb with morph targets, its times (T,), and its faces."""
    data = file.read_bytes()
    magic, _, size, length, _ = struct.unpack("<4sIII4s", data[:20])
    assert magic == b"glTF" and size == len(data)
    content, body = json.loads(data[20 : 20 + length]), data[28 + length :]

    def array(index):
        entry = content["accessors"][index]
        view = content["bufferViews"][entry["bufferView"]]
        return np.frombuffer(body[view["byteOffset"] :][: view["byteLength"]], "<f4").reshape(
            entry["count"], -1
        )

    primitives = [primitive for mesh in content["meshes"] for primitive in mesh["primitives"]]
    first = np.concatenate([array(each["attributes"]["POSITION"]) for each in primitives])
    moves = [[array(target["POSITION"]) for target in each["targets"]] for each in primitives]
    targets = np.concatenate([np.stack(each) for each in moves], axis=1)
    sampler = content["animations"][0]["samplers"][0]
    time = array(sampler["input"])[:, 0]
    weights = array(sampler["output"]).reshape(len(time), -1)
    return first + np.einsum("tk,knc->tnc", weights, targets), time


def test_surface_as_gltf(moved):
    folder, bodies, x, time = moved
    vertices, at = shown(folder / "surface.glb")
    np.testing.assert_allclose(at, time, rtol=1e-6)
    meshes = trimesh.load(folder / "surface.glb", process=False).geometry.values()
    mesh = trimesh.util.concatenate(
        [trimesh.Trimesh(each.vertices, each.faces, process=False) for each in meshes]
    )
    np.testing.assert_array_equal(mesh.vertices, vertices[0])
    parts = trimesh.graph.connected_components(mesh.face_adjacency, min_len=100)
    assert len(parts) == bodies
    for k in range(len(x)):
        assert_around(vertices[k], x[k])


@pytest.mark.skipif(not USD, reason="usd-core is not installed: make viewer")
@pytest.mark.parametrize("kind", ["usdc", "usda"])
def test_surface_as_usd(moved, kind):
    from pxr import Usd, UsdGeom, UsdValidation

    folder, _, _, time = moved
    stage = Usd.Stage.Open(str(folder / f"surface.{kind}"))
    parts = [UsdGeom.Mesh(part) for part in stage.GetDefaultPrim().GetChildren()]
    points = [part.GetPointsAttr() for part in parts if not part.GetPrim().GetName().startswith("obstacle")]
    samples = points[0].GetTimeSamples()
    np.testing.assert_allclose(np.array(samples) / stage.GetTimeCodesPerSecond(), time, rtol=1e-6)
    loaded = np.stack([np.concatenate([np.array(each.Get(sample)) for each in points]) for sample in samples])
    np.testing.assert_allclose(loaded, shown(folder / "surface.glb")[0], atol=1e-6)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in errors] == []


def test_films(moved):
    folder, _, x, _ = moved
    film = np.stack(imageio.mimread(folder / "motion.mp4", memtest=False)).astype(int)
    assert len(film) == len(x)
    with Image.open(folder / "motion.gif") as image:
        assert image.n_frames == len(x) and image.size == film.shape[2:0:-1]
    seen = film.min(axis=3) < 200
    assert seen.any(axis=(1, 2)).all(), "a body in every frame"
    assert not seen[:, [0, -1]].any() and not seen[:, :, [0, -1]].any(), "and none cut at the border"
    assert seen.any(axis=0).any(axis=0).mean() > 0.5 or seen.any(axis=0).any(axis=1).mean() > 0.5
    assert abs(film[-1] - film[0]).max() > 100


def test_a_film_in_slow_motion_shows_the_same_frames_longer(full):
    durations = []
    for name in ("motion.gif", "motion_slow4.gif"):
        with Image.open(full.root / f"{SCENE}/{SPRINGS}/export" / name) as film:
            durations.append([frame.info["duration"] for frame in ImageSequence.Iterator(film)])
    normal, slow = durations
    assert len(slow) == len(normal) and sum(slow) == pytest.approx(4 * sum(normal), abs=40)


def test_blend(moved):
    folder, _, _, time = moved
    loaded = read_blend(folder / "motion.blend", time.tolist())
    # times are single precision in Blender, a frame is 1/24 s
    np.testing.assert_allclose(loaded["co"], shown(folder / "surface.glb")[0], atol=1e-4)
    with Image.open(folder / "motion.png") as image:
        assert 0.002 < (np.asarray(image)[..., 3] > 128).mean() < 0.9
