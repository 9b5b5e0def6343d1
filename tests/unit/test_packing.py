"""A packed dataset is what was packed, pixel by pixel, or an error that says what to do; the workflow takes it."""

import json

import numpy as np
import pytest
from PIL import Image

from neuma_lib.errors import InputError
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.io.images import list_images, read_image_set, write_transforms
from neuma_lib.io.packed import STEPS, pack_images, pack_truth, unpack_images, unpack_truth

FRAMES = (0, 3, 6, 9, 20, 30, 40)  # of tests/workflow/tiny.yaml


def write_set(folder, steps, views=2):
    """Noisy boxes on a transparent background with a colour of its own; every camera has its own focal length."""
    random = np.random.default_rng(len(steps))
    folder.mkdir(parents=True)
    frames = []
    for view in range(views):
        for step in steps:
            image = np.empty((24, 32, 4), dtype=np.uint8)
            image[:] = (1, 1, 1, 0)
            image[5 : 12 + view, 8:20] = random.integers(0, 256, (7 + view, 12, 4))  # hidden colours too
            image[8, 10, 3] = 255
            name = f"d_{view}_{step:04d}.png"
            Image.fromarray(image).save(folder / name)
            pose = np.eye(4)
            pose[:3, 3] = (0.5, 0.1 * view, 2.0)
            place = {"file_path": name, "transform_matrix": pose.tolist(), "fl_x": 40.0 + view}
            frames.append({**place, "view": view, "step": step, "time": step * 2e-3})
    write_transforms(folder / "transforms.json", {"w": 32, "h": 24, "cx": 16.0, "cy": 12.0}, frames)


def write_truth(path, count=60):
    """A ground truth of smooth motions."""
    random = np.random.default_rng(0)
    time = np.array(FRAMES)[:, None, None] * 2e-3

    def path_of(n):
        start, speed = random.uniform(0.2, 0.8, (n, 3)), random.normal(0, 1, (n, 3))
        return (start + time * speed - 4.9 * time**2 * [0, 1, 0]).astype(np.float32)

    arrays = {
        "x": path_of(count),
        "v": path_of(count),
        "F": (np.eye(3) + 0.1 * random.normal(size=(len(FRAMES), count, 3, 3))).astype(np.float32),
        "frames": np.array(FRAMES),
        "time": np.array(FRAMES) * 2e-3,
        "vol0": np.full(count, 1e-5, np.float32),
        "mass": np.full(count, 1e-2, np.float32),
        "tracers": path_of(100),
        "tracers_again": path_of(90),
    }
    write_arrays(path, arrays, {"dt": 2e-3, "bodies": [{"shape": "ball"}]})
    return arrays


@pytest.fixture
def scene(tmp_path):
    """The folder of a scene's dataset."""
    folder = tmp_path / "scene"
    write_set(folder / "static", steps=(0,), views=5)
    write_set(folder / "dynamic", steps=FRAMES)
    write_truth(folder / "particles.h5")
    return folder


def sets(folder):
    return {part: folder / part / "transforms.json" for part in ("static", "dynamic")}


def unpack_all(packed, folder):
    for part, file in sets(folder).items():
        unpack_images(packed, part, file)


def assert_same_images(first, second):
    for ours, theirs in zip(sets(first).values(), sets(second).values(), strict=True):
        a, b = read_image_set(ours), read_image_set(theirs)
        for name in ("images", "viewmats", "Ks", "views", "steps"):
            assert np.array_equal(getattr(a, name), getattr(b, name)), name
        data = [json.loads(file.read_text()) for file in (ours, theirs)]
        for frame in (frame for transforms in data for frame in transforms["frames"]):
            del frame["sha256"]  # of the file: packed images are WebP
            frame["file_path"] = frame["file_path"].removesuffix(".png").removesuffix(".webp")
        assert data[0] == data[1]


class TestImages:
    def test_pixels_and_cameras_come_back(self, scene, tmp_path):
        packed, unpacked = tmp_path / "images.zip", tmp_path / "unpacked"
        pack_images(packed, sets(scene))
        for part, file in sets(unpacked).items():
            unpack_images(packed, part, file, FRAMES if part == "dynamic" else [0])
        assert_same_images(scene, unpacked)

    def test_same_images_same_bytes(self, scene, tmp_path):
        files = [tmp_path / "first.zip", tmp_path / "second.zip"]
        for file in files:
            pack_images(file, sets(scene))
        assert files[0].read_bytes() == files[1].read_bytes()

    def test_what_was_unpacked_packs_to_the_same_bytes(self, scene, tmp_path):
        pack_images(tmp_path / "first.zip", sets(scene))
        unpack_all(tmp_path / "first.zip", tmp_path / "unpacked")
        pack_images(tmp_path / "second.zip", sets(tmp_path / "unpacked"))
        assert (tmp_path / "first.zip").read_bytes() == (tmp_path / "second.zip").read_bytes()

    def test_images_elsewhere_come_home(self, scene, tmp_path):
        """A list of images in another folder is packed by their names."""
        listed = tmp_path / "listed" / "transforms.json"
        list_images(sets(scene)["dynamic"], listed)
        pack_images(tmp_path / "images.zip", {"dynamic": listed})
        unpack_images(tmp_path / "images.zip", "dynamic", tmp_path / "unpacked" / "transforms.json")
        assert (tmp_path / "unpacked" / "d_1_0040.webp").is_file()

    def test_other_steps_are_refused(self, scene, tmp_path):
        pack_images(tmp_path / "images.zip", sets(scene))
        with pytest.raises(InputError, match=r"7 frames at steps 0, 3, \.\.\., 40, .* ask for 3 at 0, 1, 2"):
            unpack_images(tmp_path / "images.zip", "dynamic", tmp_path / "out" / "a.json", (0, 1, 2))
        assert not (tmp_path / "out").exists()


class TestTruth:
    def test_within_half_a_step(self, scene, tmp_path):
        before, _ = read_arrays(scene / "particles.h5")
        pack_truth(tmp_path / "truth.h5", scene / "particles.h5", particles=60, deformations=20, seed=1)
        unpack_truth(tmp_path / "truth.h5", tmp_path / "particles.h5", FRAMES, 2e-3)
        after, attributes = read_arrays(tmp_path / "particles.h5")
        for name, array in after.items():
            if name != "F":
                assert np.abs(array - before[name]).max() <= STEPS.get(name, 0) / 2 + 1e-7, name
                assert array.dtype == before[name].dtype
        near = np.abs(after["F"][:, :, None] - before["F"][:, None]).max(axis=(0, 3, 4)).min(axis=1)
        assert after["F"].shape[1] == 20 and near.max() <= STEPS["F"] / 2 + 1e-7
        assert attributes["dt"] == 2e-3 and json.loads(attributes["bodies"]) == [{"shape": "ball"}]
        assert json.loads(attributes["packed"])["rounded_to"] == STEPS

    def test_a_part_of_the_particles_has_all_the_mass(self, scene, tmp_path):
        before, _ = read_arrays(scene / "particles.h5")
        pack_truth(tmp_path / "truth.h5", scene / "particles.h5", particles=25, deformations=5, seed=1)
        unpack_truth(tmp_path / "truth.h5", tmp_path / "particles.h5")
        after, _ = read_arrays(tmp_path / "particles.h5")
        assert after["x"].shape[1] == len(after["mass"]) == 25
        for name in ("mass", "vol0"):
            np.testing.assert_allclose(after[name].sum(), before[name].sum(), rtol=1e-6)
        apart = np.abs(after["x"][:, :, None] - before["x"][:, None]).max(axis=(0, 3)).min(axis=1)
        assert apart.max() <= STEPS["x"] / 2 + 1e-7

    @pytest.mark.parametrize(
        ("wanted", "message"),
        [
            ({"steps": FRAMES[:-1]}, "7 frames at steps .*, the settings ask for 6"),
            ({"dt": 1e-3}, r"dt = 0\.002 s, the scene has 0\.001 s"),
        ],
    )
    def test_another_simulation_is_refused(self, scene, tmp_path, wanted, message):
        pack_truth(tmp_path / "truth.h5", scene / "particles.h5", particles=25, deformations=5, seed=1)
        with pytest.raises(InputError, match=message):
            unpack_truth(tmp_path / "truth.h5", tmp_path / "particles.h5", **wanted)
        assert not (tmp_path / "particles.h5").exists()


def spoil(path, damage):
    data = path.read_bytes()
    if damage == "missing":
        path.unlink()
    elif damage == "truncated":
        path.write_bytes(data[: len(data) // 2])
    elif damage == "flipped":
        # in a member: the start of an archive, the middle of HDF5 (whose start is its own metadata)
        place = len(data) // (3 if path.suffix == ".zip" else 2)
        path.write_bytes(
            data[:place] + bytes(b ^ 0x55 for b in data[place : place + 64]) + data[place + 64 :]
        )
    elif damage == "foreign":
        path.write_text("no archive")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ("missing", "does not exist: put the packed file there, or set dataset.packed: null"),
        ("truncated", "cannot be read as"),
        ("flipped", "is damaged|cannot be read as"),
        ("foreign", "cannot be read as"),
    ],
)
@pytest.mark.parametrize("kind", ["images.zip", "truth.h5"])
def test_a_damaged_file_is_named(scene, tmp_path, kind, damage, message):
    file = tmp_path / f"Ball.{kind}"
    if kind == "images.zip":
        pack_images(file, sets(scene))
    else:
        pack_truth(file, scene / "particles.h5", particles=50, deformations=50, seed=1)
    spoil(file, damage)
    with pytest.raises(InputError, match=rf"Ball\.{kind}.*({message})"):
        if kind == "images.zip":
            unpack_all(file, tmp_path / "out")
        else:
            unpack_truth(file, tmp_path / "out" / "particles.h5")
    assert not list(tmp_path.glob("out/dynamic/transforms.json")) + list(tmp_path.glob("out/**/*.h5"))


def test_files_of_another_kind_are_refused(scene, tmp_path):
    pack_images(tmp_path / "images.zip", sets(scene))
    with pytest.raises(InputError, match=r"images\.zip cannot be read as HDF5"):
        unpack_truth(tmp_path / "images.zip", tmp_path / "particles.h5")
    with pytest.raises(InputError, match=r"holds None, not NeuMA ground truth 2: give the other file"):
        unpack_truth(scene / "particles.h5", tmp_path / "particles.h5")
