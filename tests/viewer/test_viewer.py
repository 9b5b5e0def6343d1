"""The viewer's data, and the file that it writes."""

import json
import re
import zlib
from base64 import b64decode
from dataclasses import replace

import numpy as np
import pytest
import torch

from neuma_lib.geometry.obstacles import obstacles
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.project.files import SceneFiles, inside
from neuma_lib.project.find import find_scene
from neuma_lib.sim.colliders import Collider
from neuma_lib.viewer import scalars
from neuma_lib.viewer.page import Blob, _obstacle, page, quantised, roots
from neuma_lib.viewer.scene import load_scene
from tests.support.errors import refused
from tests.support.sim_scenes import SPECS, make_law
from tests.support.viewer_project import FALL, SCENE, STEPS, STRETCH, make_project


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_project(tmp_path_factory.mktemp("viewer"))


@pytest.fixture(scope="module")
def scene(folder):
    return load_scene(find_scene(folder)[1])


def motion_of(scene, name):
    return next(motion for motion in scene.motions if motion.name == name)


def stretched(a):
    """A stretch that keeps the volume, e^a along x, turned about z."""
    c, s = np.cos(0.7), np.sin(0.7)
    turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return turn @ torch.diag(torch.tensor([a, -a / 2, -a / 2], dtype=torch.float64).exp())


def test_von_mises_stress_of_a_stretch_has_a_closed_form():
    """Hencky: s = 2 G dev log(stretch), so that sqrt(3/2 s : s) = 3 G a; pressure alone gives none."""
    law, (E, nu) = make_law("hencky"), (SPECS["hencky"]["elasticity"][key] for key in ("E", "nu"))
    G = E / (2 * (1 + nu))
    F = torch.stack([stretched(0.2), stretched(-0.1), 1.1 * torch.eye(3, dtype=torch.float64)])
    wanted = torch.tensor([3 * G * 0.2, 3 * G * 0.1, 0.0], dtype=torch.float64)
    assert torch.allclose(scalars.von_mises(law, F), wanted, rtol=1e-9, atol=1e-7)
    assert torch.allclose(scalars.von_mises(law, 1.1 * F), wanted / 1.1**3, rtol=1e-9, atol=1e-7), "Cauchy's"


def test_plastic_strain_is_zero_for_an_elastic_body():
    F, flowed = stretched(0.15)[None], stretched(0.3)[None]
    assert torch.allclose(scalars.plastic_strain(F, F @ flowed), flowed.new_tensor([0.3]))
    assert scalars.plastic_strain(F, F).abs().max() < 1e-12


def test_plastic_strain_is_zero_where_the_deformation_is_singular():
    F = torch.stack([torch.zeros(3, 3), torch.diag(torch.tensor([1.0, 1.0, 1e-42])), stretched(0.15).float()])
    strain = scalars.plastic_strain(F, F + 0.1)
    assert strain.isfinite().all() and strain[0] == 0 and strain[2] > 0


def test_total_deformation_is_exact_for_affine_motions():
    generator = torch.Generator().manual_seed(0)
    x0 = torch.rand(200, 3, generator=generator, dtype=torch.float64)
    A = torch.eye(3, dtype=torch.float64) + 0.5 * torch.rand(3, 3, generator=generator, dtype=torch.float64)
    result = scalars.total_deformation(torch.stack([x0, x0 @ A.T + 0.3]))
    assert torch.allclose(
        result, torch.stack([torch.eye(3, dtype=torch.float64), A])[:, None].expand(2, 200, 3, 3)
    )


def test_speed_of_a_uniform_motion_at_uneven_times():
    times = torch.tensor([0.0, 0.1, 0.4])
    x = (times[:, None, None] * torch.tensor([3.0, 0.0, 4.0])).expand(3, 5, 3)
    assert torch.allclose(scalars.speed(x, times), torch.full((3, 5), 5.0))
    assert scalars.speed(x[:1], times[:1]).sum() == 0


def test_legend_ranges_are_round_and_of_the_median_motion():
    motions = [{"speed": torch.full((9,), value)} for value in (2.2, 2.3, 400.0)]
    motions[0]["volume_ratio"] = torch.tensor([0.93, 1.01])
    assert scalars.ranges(motions) == {"speed": (0.0, 3.0), "volume_ratio": pytest.approx((0.92, 1.08))}
    for value in (1e-3, 0.99, 1.0, 7.3e5):
        assert value <= scalars.rounded_up(value) * (1 + 1e-9) and scalars.rounded_up(value) < 1.6 * value


def test_a_folder_gives_truth_and_methods_with_gaussians_that_follow(scene):
    assert [motion.name for motion in scene.motions] == ["truth", "nclaw", "constants"]
    assert scene.steps == STEPS and scene.name == SCENE
    wanted = 0.5 + (scene.gaussians.means - 0.5) @ STRETCH.T - torch.tensor([0.0, FALL, 0.0])
    A = STRETCH @ scene.gaussians.covars() @ STRETCH.T
    for name in ("truth", "constants"):  # both follow affine motions exactly
        motion = motion_of(scene, name)
        assert torch.allclose(motion.means[-1], wanted, atol=2e-6)
        assert torch.allclose(motion.covars[-1], A, atol=1e-8)
        assert set(motion.scalars) == set(scalars.QUANTITIES)
    true, result = (motion_of(scene, name).scalars for name in ("truth", "constants"))
    for name in ("von_mises", "volume_ratio"):  # the same law and deformation
        assert torch.allclose(true[name][-1].mean(), result[name][-1].mean(), rtol=1e-5)
    assert true["speed"].allclose(torch.tensor(3.0).sqrt()), "the stored velocities"
    assert result["plastic_strain"].max() < 1e-3, "all of it is elastic"


def test_a_law_of_another_time_step_is_shown_at_the_same_times(tmp_path, scene):
    place = make_project(tmp_path, methods=("nclaw",))
    arrays, attributes = read_arrays(place / "nclaw" / "rollout.h5", ("x", "F", "frames"))
    refined = {**arrays, "frames": 2 * arrays["frames"]}
    write_arrays(place / "nclaw" / "rollout.h5", refined, {"dt": attributes["dt"] / 2})
    again = motion_of(load_scene(find_scene(place)[1]), "nclaw")
    assert again.steps == motion_of(scene, "nclaw").steps
    assert torch.allclose(again.scalars["speed"], motion_of(scene, "nclaw").scalars["speed"])


def test_motions_of_one_title_get_their_names(folder):
    from dataclasses import replace

    files = find_scene(folder)[1]
    same = replace(files, runs=tuple(replace(run, title="Mine") for run in files.runs))
    assert [motion.title for motion in load_scene(same).motions] == [
        "Truth",
        "Mine (nclaw)",
        "Mine (constants)",
    ]


def test_cameras_have_their_images(scene):
    (view,) = scene.views
    assert sorted(view.images) == list(STEPS) and view.images[30].shape == (24, 32, 4)
    assert (view.images[30][..., 1] == 60).all()
    assert np.allclose(np.linalg.inv(view.viewmat)[:3, 3], [0.5, 0.4, 1.6])


def test_plain_values_describe_the_files(folder):
    files = find_scene(folder)[1]
    assert SceneFiles.of_plain(json.loads(json.dumps(files.plain()))) == files
    assert str(folder / "constants" / "rollout.h5") in files.files


def test_nothing_outside_the_folders_is_read(tmp_path):
    place = make_project(tmp_path / "project", methods=("constants", "nclaw"))
    secret = tmp_path / "secret.h5"
    secret.write_bytes((place / "nclaw" / "rollout.h5").read_bytes())
    roots_ = (tmp_path / "project" / "results", tmp_path / "project" / "data")
    assert inside(place / "nclaw" / "rollout.h5", roots_)
    for outside in (secret, place / ".." / ".." / ".." / "secret.h5"):
        with refused(outside):
            inside(outside, roots_)
    (place / "nclaw" / "rollout.h5").unlink()
    (place / "nclaw" / "rollout.h5").symlink_to(secret)
    files = find_scene(place)[1]
    with refused("rollout.h5"):
        load_scene(files)
    result = load_scene(files, skip_damaged=True)
    assert [motion.name for motion in result.motions] == ["truth", "constants"]
    assert "NCLaw is left out" in result.notes[0]


def test_an_image_outside_the_data_is_not_read(tmp_path):
    place = make_project(tmp_path / "project", methods=("constants",))
    transforms = tmp_path / "project" / "data" / SCENE / "dynamic" / "transforms.json"
    (transforms.parent / "d_10.png").rename(tmp_path / "d_10.png")
    transforms.write_text(transforms.read_text().replace("d_10.png", "../../../../d_10.png"))
    result = load_scene(find_scene(place)[1])
    assert not result.views and "is outside" in result.notes[0]


def test_bad_folders_are_refused_with_a_remedy(folder, tmp_path):
    with refused("nothing"):
        find_scene(tmp_path / "nothing")
    (tmp_path / "results" / SCENE).mkdir(parents=True)
    with refused(tmp_path / "results" / SCENE):
        find_scene(tmp_path / "results" / SCENE)
    with refused("priors"):
        find_scene(folder.parent / "priors")
    (folder.parent / "JellyDuck").mkdir()
    with refused("JellyDuck/particles.h5") as error:
        find_scene(folder.parent / "JellyDuck")
    assert "snakemake" in error.value.remedy


@pytest.mark.parametrize("bits", [8, 16])
def test_frames_are_decoded_to_half_a_quantisation_step(bits):
    """Decoded as page.js does it."""
    values = np.random.default_rng(0).normal(size=(5, 3, 40)).cumsum(axis=0)
    blob = Blob()
    blob.add(b"before")
    entry = blob.frames(values, bits=bits)
    decoded = decode(b"".join(blob.parts), entry)
    step = (values.max(axis=(0, 2)) - values.min(axis=(0, 2))) / (2**bits - 1)
    assert (np.abs(decoded - values) <= 0.5001 * step[:, None]).all()


def decode(data, entry):
    T, size = entry["frames"], entry["components"] * entry["count"]
    wide = entry["bits"] == 16
    raw = np.frombuffer(data, np.uint8, T * size * (1 + wide), entry["start"]).astype(np.int64)
    code = raw[: T * size] + (raw[T * size :] << 8 if wide else 0)
    signed = (code >> 1) ^ -(code & 1)
    whole = np.cumsum(signed.reshape(T, size), axis=0) % 2 ** entry["bits"]
    low, high = (np.array(entry[key])[:, None] for key in ("low", "high"))
    return low + (high - low) * whole.reshape(T, entry["components"], -1) / (2 ** entry["bits"] - 1)


def test_quantised_values_are_clipped():
    ends = np.array([0.0]), np.array([2.0])
    assert quantised(np.array([[[-1.0, 0.0, 2.0, 9.0]]]), *ends, 8).tolist() == [[[0, 0, 255, 255]]]


def test_roots_are_square_roots_of_covariances(scene):
    covars = motion_of(scene, "truth").covars
    a, b, c, d, e, f = roots(covars).transpose(1, 0, 2)
    half = np.stack([[a, b, c], [b, d, e], [c, e, f]]).transpose(2, 3, 0, 1)
    assert np.allclose(half @ half, covars.numpy(), atol=1e-9)


def test_the_file_is_complete_and_reproducible(scene):
    text = page(scene)
    assert text == page(scene)
    meta = json.loads(re.search(r'id="meta">(.*?)</script>', text, re.S)[1])
    data = zlib.decompress(b64decode(re.search(r'id="data">(.*?)</script>', text, re.S)[1]))
    for motion, entry in zip(scene.motions, meta["motions"], strict=True):
        assert entry["title"] == motion.title and set(entry["scalars"]) == set(motion.scalars)
        for name, values, wide in (("x", motion.x, 1), ("means", motion.means, 1)):
            result, wanted = decode(data, entry[name]), values.transpose(1, 2).numpy()
            reach = np.subtract(entry[name]["high"], entry[name]["low"]).max()
            assert np.abs(result - wanted).max() <= 0.51 * reach / 65535 * wide + 1e-7
    assert meta["steps"] == list(STEPS) and len(meta["views"][0]["images"]) == len(STEPS)
    assert not re.search(r"(src|href)=|https?://|url\(|import\s*\(", text), "it loads nothing"


def test_frames_are_dropped_from_a_file_that_is_too_large(scene):
    whole = len(page(scene))
    logged, limit = [], round(0.95 * whole / 1e6, 4)
    smaller = page(scene, megabytes=limit, log=logged.append)
    meta = json.loads(re.search(r'id="meta">(.*?)</script>', smaller, re.S)[1])
    assert meta["limits"] == logged == [f"2 of 4 frames (limit: viewer.megabytes = {limit:g})"]
    assert len(smaller) < 0.95 * whole and meta["steps"][0] == 0 and meta["steps"][-1] == STEPS[-1]
    with refused("viewer.megabytes"):
        page(scene, megabytes=0.01)
    logged.clear()
    assert len(page(scene, particles=300, log=logged.append)) < whole
    assert logged[0] == "Truth: 300 of 900 particles (limit: viewer.particles = 300)" and len(logged) == 3
    logged.clear()
    page(scene, log=logged.append)
    assert not logged


def test_names_are_escaped(scene):
    from dataclasses import replace

    text = page(replace(scene, name="</script><b>@DATA@", notes=("</script>",)))
    assert text.count("</script>") == 3 and "&lt;/script>" in text


def test_the_file_has_obstacles_with_their_poses(scene):
    """Triangles in the frame of the obstacle within half a quantisation step, and one pose a frame if it moves."""
    moving = Collider("box", (0.1, 0.2, 0.3), (0.5, 0.2, 0.5), spin=(0.0, 3.0, 0.0))
    crowded = replace(scene, colliders=(moving, Collider.plane((0, 0.1, 0), (0, 1, 0))))
    times = [crowded.dt * step for step in crowded.steps]
    blob = Blob()
    box, plane = (_obstacle(each, blob) for each in obstacles(crowded.colliders, times))
    corners = decode(b"".join(blob.parts), box["corners"])[0].T
    (expected,) = obstacles([moving], times)
    np.testing.assert_allclose(corners, expected.vertices[expected.faces].reshape(-1, 3), atol=0.6 / 2**17)
    np.testing.assert_allclose(np.reshape(box["poses"], (-1, 3, 4)), expected.poses[:, :3], atol=1e-6)
    assert len(box["poses"]) == len(times) > 1 == len(plane["poses"])
    assert '"obstacles":[{"corners"' in page(crowded)
