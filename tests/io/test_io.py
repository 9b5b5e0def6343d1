"""Reading gives what was written, equal content gives equal bytes, and damaged files are reported."""

import errno
import json
import os
import resource

import numpy as np
import pytest
import torch
from PIL import Image

from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.io.files import atomic, read_json, write_json
from neuma_lib.io.gaussians import load_gaussians, save_gaussians
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.io.images import list_body, load_observation, read_hidden, read_image_set, write_transforms
from neuma_lib.io.mesh import read_mesh, write_mesh
from neuma_lib.io.particles import with_motion, with_motions
from neuma_lib.io.ply import read_ply, write_ply
from neuma_lib.io.weights import read_weights, write_weights
from neuma_lib.splatting.gaussians import Gaussians
from tests.support.errors import refused
from tests.support.grounding_scene import ball

pytestmark = pytest.mark.core

RNG = np.random.default_rng(0)


def cube():
    import trimesh

    return trimesh.creation.box((0.2, 0.2, 0.2))


# ---- safety of writing


def test_a_failing_writer_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "metrics.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueError):
        write_json(path, {"a": float("nan")})
    with pytest.raises(RuntimeError), atomic(path) as partial:
        partial.write_text("half")
        raise RuntimeError
    assert read_json(path) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["metrics.json"]


WRITERS = {
    "json": lambda path: write_json(path, list(range(10_000))),
    "HDF5": lambda path: write_arrays(path, {"x": np.zeros((10_000, 3))}),
    "safetensors": lambda path: write_weights(path, {"w": torch.zeros(10_000)}, {}),
    "checkpoint": lambda path: Checkpoint(path, {}).save({"w": torch.zeros(10_000)}),
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_a_full_disk_is_one_line_and_leaves_no_file(tmp_path, write):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))  # as if the disk had 10 kB left
    try:
        with refused("target", problem="cannot be written", remedy="Free disk space"):
            write(tmp_path / "target")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES])
def test_a_read_only_folder_is_one_line(tmp_path, monkeypatch, number):
    def mkdir(*_, **__):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("pathlib.Path.mkdir", mkdir)
    with refused("target", problem="cannot be written", remedy="results_root"):
        write_json(tmp_path / "target", {})


def test_the_name_keeps_its_ending_while_written(tmp_path):
    with atomic(tmp_path / "video.mp4") as partial:
        assert partial.suffix == ".mp4" and partial.parent == tmp_path
        partial.write_bytes(b"")


def test_json(tmp_path):
    (tmp_path / "broken.json").write_text('{"a": ')
    with refused("broken.json"):
        read_json(tmp_path / "broken.json")
    with refused("absent.json"):
        read_json(tmp_path / "absent.json")


# ---- arrays


def trajectory():
    return {
        "x": RNG.random((3, 5, 3), dtype=np.float32),
        "F": RNG.random((3, 5, 3, 3), dtype=np.float32),
        "frames": np.array([0, 4, 9]),
        "C": None,
    }


def test_arrays_round_trip_with_units(tmp_path):
    import h5py

    arrays, path = trajectory(), tmp_path / "particles.h5"
    write_arrays(path, arrays, {"dt": 1e-3, "scene": {"shape": "ball"}, "title": "Ball"})
    read, attributes = read_arrays(path, required=("x", "frames"))
    assert set(read) == {"x", "F", "frames"}
    for name, array in read.items():
        assert array.dtype == arrays[name].dtype
        np.testing.assert_array_equal(array, arrays[name])
    assert attributes["dt"] == 1e-3 and json.loads(attributes["scene"]) == {"shape": "ball"}
    with h5py.File(path) as file:
        assert file["x"].attrs["unit"] == "m" and "shape (T, N, 3)" in file["x"].attrs["description"]
    only, _ = read_arrays(path, only=("x",))
    assert set(only) == {"x"}


def test_arrays_problems(tmp_path):
    path = tmp_path / "particles.h5"
    write_arrays(path, trajectory())
    with refused("particles.h5", problem="v, tracers"):
        read_arrays(path, required=("x", "v", "tracers"))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with refused("particles.h5"):
        read_arrays(path)
    write_arrays(path, {"x": np.full((2, 3), np.nan)})
    with refused("particles.h5"):
        read_arrays(path)


# ---- image sets

INTRINSICS = {"fl_x": 20.0, "fl_y": 21.0, "cx": 8.0, "cy": 6.0, "w": 16, "h": 12}


@pytest.fixture
def image_set(tmp_path):
    """Two views at three steps, written out of order."""
    frames = []
    for step in (5, 0, 2):
        for view in (1, 0):
            name = f"d_{view}_{step:03d}.png"
            pixels = np.full((12, 16, 4), 10 * step + view, dtype=np.uint8)
            pixels[2:9, 3:12, 3] = 255
            Image.fromarray(pixels, "RGBA").save(tmp_path / name)
            pose = np.eye(4)
            pose[:3, 3] = (0.1 * view, 0.5, 2.0)
            frame = {"file_path": name, "transform_matrix": pose.tolist(), "view": view, "step": step}
            frames.append({**frame, "time": 1e-3 * step})
    path = tmp_path / "transforms.json"
    write_transforms(path, INTRINSICS, frames)
    return path


def edit(path, change):
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))


def test_images_of_one_of_several_bodies(image_set, tmp_path):
    """Empty where another body is seen; frames without the body are not listed."""
    labels = np.zeros((12, 16), dtype=np.uint8)
    labels[2:9, 3:8], labels[2:9, 8:12] = 1, 2

    def with_labels(data):
        for frame in data["frames"]:
            frame["label_path"] = f"label_{frame['file_path']}"
            visible = np.where(labels == 2, 0, labels) if frame["step"] == 5 else labels
            Image.fromarray(visible).save(image_set.parent / frame["label_path"])

    edit(image_set, with_labels)
    first, second = tmp_path / "first" / "transforms.json", tmp_path / "second" / "transforms.json"
    assert list_body(image_set, first, 1) == (6, 6) and list_body(image_set, second, 2) == (4, 6)
    images = read_image_set(second)
    assert images.steps.tolist() == [0, 0, 2, 2]
    whole = read_image_set(image_set).images[2, ..., 3]
    pixels = np.argwhere(labels > 0)
    for at in np.ndindex(labels.shape):
        nearest = pixels[np.square(pixels - at).sum(axis=1).argmin()] if whole[at] <= 127 else at
        assert images.images[0, ..., 3][at] == whole[at] * (labels[tuple(nearest)] == 2)
    np.testing.assert_array_equal(images.images[..., :3], read_image_set(image_set).images[2:, ..., :3])
    np.testing.assert_array_equal(read_hidden(second)[0], labels == 1)
    assert read_hidden(image_set) is None
    video = load_observation(second, [0, 1])
    assert video.hidden.shape == (2, 2, 12, 16) and torch.equal(
        video.hidden[0, 0], torch.from_numpy(labels == 1)
    )
    assert torch.equal(video.select([1]).hidden, video.hidden[1:])
    assert (video.colours()[video.hidden] == 1).all()
    with refused("transforms.json", problem="body 3"):
        list_body(image_set, tmp_path / "third" / "transforms.json", 3)


def test_image_set(image_set):
    images = read_image_set(image_set)
    assert images.images.shape == (6, 12, 16, 4) and images.images.dtype == np.uint8
    assert (images.width, images.height) == (16, 12)
    assert images.views.tolist() == [1, 0] * 3 and images.steps.tolist() == [5, 5, 0, 0, 2, 2]
    np.testing.assert_allclose(images.Ks[0], [[20, 0, 8], [0, 21, 6], [0, 0, 1]])
    # A point one metre in front of an OpenGL camera (its -z) is one metre along +z of the OpenCV camera.
    point = images.viewmats[0] @ np.array([0.1, 0.6, 1.0, 1.0])
    np.testing.assert_allclose(point, [0, -0.1, 1, 1], atol=1e-12)
    assert len(read_image_set(image_set, views=[1]).images) == 3
    video = load_observation(image_set, [0, 1])
    assert video.frames == (0, 2, 5) and video.images.shape == (3, 2, 12, 16, 4)
    assert video.images[2, 1, 0, 0, 0] == 51


def test_camera_angle_and_own_intrinsics_of_a_frame(image_set):
    angle = 2 * np.arctan(16 / (2 * 20.0))

    def change(data):
        for key in ("fl_x", "fl_y", "cx", "cy"):
            del data[key]
        data["camera_angle_x"] = angle
        data["frames"][0]["fl_x"] = 40.0

    edit(image_set, change)
    Ks = read_image_set(image_set).Ks
    np.testing.assert_allclose(Ks[1], [[20, 0, 8], [0, 20, 6], [0, 0, 1]])
    assert Ks[0, 0, 0] == 40.0


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda d: [d.pop(k) for k in ("fl_x", "fl_y")], "transforms.json: frame 0 (d_1_005.png)"),
        (lambda d: d.update(fl_x=-3), "frame 0 (d_1_005.png): fl_x"),
        (lambda d: d.update(frames=[]), "transforms.json: frames"),
        (lambda d: d["frames"][2].pop("file_path"), "transforms.json: frame 2"),
        (lambda d: d["frames"][2].pop("transform_matrix"), "frame 2 (d_1_000.png): transform_matrix"),
        (
            lambda d: d["frames"][1].update(transform_matrix=(2 * np.eye(4)).tolist()),
            "frame 1 (d_0_005.png): transform_matrix",
        ),
        (lambda d: d.update(w=32), "w, h of d_1_005.png"),
    ],
)
def test_bad_transforms(image_set, change, where):
    edit(image_set, change)
    with refused(where):
        read_image_set(image_set)


def without_checksums(data):
    for frame in data["frames"]:
        del frame["sha256"]


def test_missing_changed_and_truncated_images(image_set):
    with Image.open(image_set.parent / "d_0_002.png") as image:
        image.transpose(Image.Transpose.ROTATE_180).save(image_set.parent / "d_0_000.png")
    with refused("d_0_000.png", problem="sha256"):
        read_image_set(image_set)
    edit(image_set, without_checksums)
    read_image_set(image_set)
    path = image_set.parent / "d_0_000.png"
    path.write_bytes(path.read_bytes()[:-40])
    with refused("d_0_000.png"):
        read_image_set(image_set)
    path.unlink()
    with refused("d_0_000.png", remedy="--forcerun"):
        read_image_set(image_set)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (Image.new("RGB", (16, 12)), "alpha channel"),
        (Image.new("RGBA", (16, 12), (9, 9, 9, 0)), "empty"),
        (Image.new("RGBA", (12, 16), (9, 9, 9, 255)), "12x16"),
        (Image.new("I;16", (16, 12)), "16 bits"),
    ],
)
def test_unusable_images(image_set, image, message):
    edit(image_set, without_checksums)
    image.save(image_set.parent / "d_0_000.png")
    with refused("d_0_000.png", problem=message):
        read_image_set(image_set)


def test_a_view_must_exist(image_set):
    with refused("transforms.json: view 7"):
        load_observation(image_set, [0, 7])


# ---- meshes


def test_meshes_of_this_library_and_of_others(tmp_path):
    mesh, path = cube(), tmp_path / "mesh.ply"
    write_mesh(path, mesh.vertices, mesh.faces)
    loaded = read_mesh(path)
    np.testing.assert_allclose(loaded.vertices, mesh.vertices, atol=1e-8)
    np.testing.assert_array_equal(loaded.faces, mesh.faces)
    for encoding in ("ascii", "binary"):
        path.write_bytes(mesh.export(file_type="ply", encoding=encoding))
        assert read_mesh(path).volume == pytest.approx(mesh.volume, rel=1e-5)


def test_bad_meshes(tmp_path):
    mesh, path = cube(), tmp_path / "mesh.ply"
    vertices = mesh.vertices.copy()
    vertices[3, 1] = np.nan
    for corners, faces, problem in (
        (vertices, mesh.faces, "vertex 3 of 8"),
        (mesh.vertices, mesh.faces[:, ::-1], "inwards"),
        (mesh.vertices, mesh.faces[1:], "watertight"),
    ):
        write_mesh(path, corners, faces)
        with refused("mesh.ply", problem=problem):
            read_mesh(path)
    assert len(read_mesh(path, watertight=False).faces) == 11
    for content, problem in ((path.read_bytes()[:-7], "claims"), (b"solid nothing", "no header")):
        path.write_bytes(content)
        with refused("mesh.ply", problem=problem):
            read_mesh(path, watertight=False)


# ---- Gaussians


def random_gaussians(count=7, bands=9, seed=0):
    rng = np.random.default_rng(seed)
    arrays = {
        "means": rng.normal(size=(count, 3)).astype(np.float32),
        "quats": (q := rng.normal(size=(count, 4)).astype(np.float32))
        / np.linalg.norm(q, axis=1, keepdims=True),
        "scales": rng.uniform(0.001, 0.1, (count, 3)).astype(np.float32),
        "opacities": rng.uniform(0.01, 0.99, count).astype(np.float32),
        "sh0": rng.normal(size=(count, 1, 3)).astype(np.float32),
        "shN": rng.normal(size=(count, bands - 1, 3)).astype(np.float32),
    }
    return Gaussians(**{name: torch.from_numpy(array) for name, array in arrays.items()})


@pytest.mark.parametrize("bands", [1, 4, 9, 16])
def test_gaussians_round_trip(tmp_path, bands):
    expected = random_gaussians(bands=bands)
    save_gaussians(tmp_path / "g.ply", expected)
    loaded = load_gaussians(tmp_path / "g.ply")
    for name, array in vars(expected).items():
        assert getattr(loaded, name).dtype == torch.float32
        torch.testing.assert_close(getattr(loaded, name), array, rtol=2e-6, atol=2e-6)


def test_gaussians_have_the_layout_of_the_3dgs_release(tmp_path):
    expected = random_gaussians(bands=16)
    save_gaussians(tmp_path / "g.ply", expected)
    rows, _ = read_ply(tmp_path / "g.ply")
    names = [*"xyz", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45))]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    assert list(rows.dtype.names) == names
    # f_rest is stored channel by channel: 15 coefficients of red, then of green, then of blue.
    np.testing.assert_array_equal(rows["f_rest_16"], expected.shN[:, 1, 1])
    np.testing.assert_allclose(rows["scale_2"], np.log(expected.scales[:, 2].numpy()), rtol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-rows["opacity"])), expected.opacities, rtol=1e-5)


def test_bad_gaussians(tmp_path):
    path = tmp_path / "g.ply"
    write_mesh(path, cube().vertices, cube().faces)
    with refused("g.ply") as error:
        load_gaussians(path)
    assert all(name in error.value.problem for name in ("f_dc_0", "opacity", "rot_3"))
    broken = random_gaussians()
    broken.means[4, 0] = np.inf
    save_gaussians(path, broken)
    with refused("g.ply", problem="means of Gaussian 4"):
        load_gaussians(path)
    rows = read_ply(path)[0].copy()
    rows["x"], rows["opacity"][:3] = 0.0, [np.inf, -np.inf, np.nan]
    write_ply(path, rows)
    with refused("g.ply", problem="opacities of Gaussian 2"):
        load_gaussians(path)
    rows["opacity"][2] = 0.0
    write_ply(path, rows)
    assert load_gaussians(path).opacities[:3].tolist() == [1.0, 0.0, 0.5], "converters from .spz write these"
    save_gaussians(path, random_gaussians(bands=4))
    path.write_bytes(path.read_bytes().replace(b"property float f_rest_8\n", b"property float other\n"))
    with refused("g.ply", problem="8 f_rest_"):
        load_gaussians(path)


# ---- weights


def test_weights(tmp_path):
    path = tmp_path / "adaptor.safetensors"
    tensors = {"elasticity.A.0": torch.randn(4, 13), "elasticity.B.0": torch.zeros(64, 4)}
    write_weights(path, tensors, {"rank": 4, "settings": {"lr": 0.1}})
    (tmp_path / "any").touch()
    assert path.stat().st_mode == (tmp_path / "any").stat().st_mode, "read by whoever reads other files"
    read, metadata = read_weights(path)
    assert metadata == {"rank": 4, "settings": {"lr": 0.1}}
    assert all(torch.equal(read[name], tensors[name]) for name in tensors)
    path.write_bytes(path.read_bytes()[:-9])
    with refused("adaptor.safetensors"):
        read_weights(path)
    write_weights(path, {"B": torch.tensor([1.0, float("nan")])}, {})
    with refused("adaptor.safetensors", problem="B is not finite"):
        read_weights(path)


# ---- same content, same bytes


@pytest.mark.parametrize(
    "write",
    [
        lambda p: write_arrays(
            p, {"x": np.arange(6.0).reshape(2, 3), "frames": np.arange(2)}, {"dt": 1.0, "b": [1]}
        ),
        lambda p: write_json(p, {"b": 1.5, "a": [1, 2]}),
        lambda p: write_mesh(p, cube().vertices, cube().faces),
        lambda p: save_gaussians(
            p, Gaussians(**{k: 0.5 * torch.ones_like(v) for k, v in vars(random_gaussians()).items()})
        ),
        lambda p: write_weights(p, {"a": torch.ones(3), "b": torch.zeros(2)}, {"z": 1, "y": 2, "x": 3}),
    ],
    ids=["h5", "json", "mesh", "gaussians", "weights"],
)
def test_same_bytes(tmp_path, write):
    contents = set()
    for folder in ("first", "second"):
        path = tmp_path / folder / "file"
        write(path)
        contents.add(path.read_bytes())
    assert len(contents) == 1
    assert str(tmp_path).encode() not in contents.pop()


def test_the_start_of_identified_json_is_an_initial_motion_like_velocity_json(tmp_path):
    body = ball()
    motion = {"v0": [0.1, -1.0, 0.2], "angular_velocity": [1.0, 2.0, 3.0], "centre": [0.5, 0.3, 0.5]}
    write_json(tmp_path / "velocity.json", motion)
    write_json(tmp_path / "identified.json", {"law": {}, "start": motion})
    one, other = (with_motion(body, tmp_path / f"{name}.json") for name in ("velocity", "identified"))
    assert torch.equal(one.v, other.v) and torch.equal(one.C, other.C) and one.C.any()


def test_bodies_that_touch_start_from_their_identification(tmp_path):
    bodies = [ball(height=0.28, count=20), ball(height=0.6, count=30)]
    motions = [
        {"name": name, "v0": [k, 0.0, 0.0], "angular_velocity": [0.0, 0.0, 0.0], "centre": [0.5, y, 0.5]}
        for name, k, y in (("clay", 1.0, 0.28), ("gum", -2.0, 0.6))
    ]
    write_json(tmp_path / "identified.json", {"start": {"bodies": motions, "separate": True}})
    state = with_motions(bodies, tmp_path / "identified.json")
    first, second = state.v.split(state.bodies)
    assert state.bodies == tuple(len(body.x0) for body in bodies)
    assert (first[:, 0] == 1.0).all() and (second[:, 0] == -2.0).all()
    torch.testing.assert_close(state.x, torch.cat([body.x0 for body in bodies]))
