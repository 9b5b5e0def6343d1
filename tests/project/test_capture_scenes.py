"""Captures as scenes, and their videos on the simulator's clock."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from neuma_lib.capture.motion.synchronisation import (
    chosen_frames,
    frame_times,
    reduced,
    reduced_intrinsics,
    reduced_labels,
    without_gain,
)
from neuma_lib.config.capture import ReleasedConfig
from neuma_lib.errors import InputError
from neuma_lib.project import cases, checks
from neuma_lib.project.capture_folder import read_capture
from neuma_lib.project.capture_scenes import captured_scenes
from neuma_lib.project.loading import load, read_yaml
from neuma_lib.project.project import Project
from neuma_lib.project.settings import NO_TRUTH
from tests.support.errors import refused


@pytest.fixture
def captures(tmp_path):
    """A capture `mug` with two takes of two cameras."""
    for take in ("one", "two"):
        (tmp_path / f"mug/videos/{take}").mkdir(parents=True)
        for camera in ("left", "right"):
            (tmp_path / f"mug/videos/{take}/{camera}.mp4").touch()
    settings(tmp_path)
    return tmp_path


def settings(root, more=""):
    (root / "mug/capture.yaml").write_text("board: {square: 0.03}\n" + more)


def loaded(root):
    return load(read_yaml("config/config.yaml"), captured=captured_scenes(root))


def test_a_capture_and_each_of_its_takes_are_scenes(captures):
    settings(captures, "density: 900\nscale: 2\n")
    scenes = loaded(captures).scenes
    assert scenes["mug"].captured.throw is None and scenes["mug_one"].captured.throw == "one"
    assert scenes["mug_one"].videos == ("mug_two",) and scenes["mug_two"].videos == ()
    assert scenes["mug_one"].training["views"] == [0, 1]
    assert scenes["mug_two"].density == 900 and scenes["mug_two"].captured.scale == 2
    assert "mug_one" not in loaded(captures).plain_scenes


def test_a_capture_falls_in_its_room_on_its_own_grid(captures):
    settings(captures, "scale: 2\n")
    config = loaded(captures)
    assert config.scene_world("mug_two") == {"grid": config.captures.grid, "gravity": [0.0, -19.62, 0.0]}
    settings(captures, "grid: 30\n")
    assert loaded(captures).scene_world("mug_two") == {"grid": 30, "gravity": [0.0, -9.81, 0.0]}
    own = config.simulation
    assert config.scene_world("BouncyBall") == {"grid": own.grid, "gravity": list(own.gravity)}


def test_takes_that_are_held_out_train_nothing(captures):
    settings(captures, "held_out: [one]\n")
    scenes = loaded(captures).scenes
    assert scenes["mug_two"].videos == () and scenes["mug_one"].videos == ()
    settings(captures, "held_out: [one, two]\n")
    assert captured_scenes(captures) == {}  # its own rules report the error


def test_a_capture_without_scenes_is_warned_of_by_default(captures, caplog):
    """As `neuma view` and other commands do, which then lack its scenes."""
    settings(captures, "held_out: [three]\n")
    assert captured_scenes(captures) == {}
    shutil.copytree("config", captures / "project/config")
    shutil.copytree(captures / "mug", captures / "project/captures/mug")
    (captures / "project/Snakefile").touch()
    loaded_settings, _ = Project.find(captures / "project")
    assert "BouncyBall" in loaded_settings.scenes and "mug" not in loaded_settings.scenes
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == 2 and all("a capture has no scenes: " in text for text in messages)
    assert all("capture.yaml: held_out: no take 'three'" in text for text in messages)


@pytest.mark.parametrize(
    "text",
    [
        "board: [",
        "a: &a [*a]",
        "&a 1: *a",
        "board: {square: true}",
        "board: {square: .inf}",
        "prior: a\nprior: b",
        "{1: 2}",
        "[" * 10_000,
        "lens: [x]",
    ],
)
def test_a_broken_capture_leaves_other_scenes_usable(captures, text):
    (captures / "cup").mkdir()
    (captures / "cup/capture.yaml").write_text(text)
    broken = []
    scenes = captured_scenes(captures, log=broken.append)
    assert {"mug", "mug_one", "mug_two"} == scenes.keys()
    (error,) = broken
    assert "cup/capture.yaml" in error.where and len(str(error).splitlines()) == 1


BODIES = "bodies: {clay: {label: 40, density: 1500}, gum: {label: 200, capture: cup}}\n"


def test_bodies_of_a_capture_are_scenes(captures):
    settings(captures, "scale: 2\n" + BODIES)
    config = loaded(captures)
    pile, part = config.scenes["mug_one"], config.scenes["mug_one_clay"]
    assert list(pile.bodies) == ["clay", "gum"] and pile.videos == () and not pile.has_truth
    assert part.part_of == ("mug_one", "clay") and not part.has_truth and part.density == 1500
    assert part.captured.capture == "mug_clay" and part.captured.throw == "one"
    assert config.scenes["mug_gum"].part_of == ("mug", "gum")
    assert config.body_scenes("mug_two") == ["mug_two_clay", "mug_two_gum"]
    assert config.scene_world("mug_one_clay")["gravity"] == [0.0, -19.62, 0.0]
    assert config.obstacles("mug_one") == {"contact": "particles"} and not checks.local_problems(config)
    whole = read_capture(captures / "mug")
    clay, gum = (replace(whole, body=name) for name in ("clay", "gum"))
    assert (whole.name, clay.name, gum.name) == ("mug", "mug_clay", "mug_gum")
    assert (clay.source, gum.source) == ("mug_clay", "cup")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (
            "bodies: {clay: {label: 1}, gum: {label: 1}}",
            "bodies.clay.label: another body has the label 1 as well",
        ),
        ("bodies: {clay: {label: 1}, gum: {label: '#ff0000'}}", "labels must be all numbers or all colours"),
        ("bodies: {clay: {}, gum: {label: 2}}", "bodies.clay.label"),
        ("bodies: {clay: {label: 0}, gum: {label: 2}}", "bodies.clay.label"),
        ("bodies: {clay: {label: 1}}", "bodies: 1 must be 2 to 5"),
        ("bodies: {a.b: {label: 1}, gum: {label: 2}}", "a name has letters"),
        (BODIES + "density: 900", "of one body only"),
    ],
)
def test_bodies_of_a_capture_that_are_refused(captures, text, problem):
    settings(captures, text + "\n")
    with pytest.raises(InputError) as caught:
        read_capture(captures / "mug")
    assert "mug/capture.yaml" in str(caught.value) and problem in str(caught.value)


def test_a_capture_of_an_unknown_prior_leaves_other_scenes_usable(captures):
    """It is an error of `neuma check` and of the targets that read the prior."""
    settings(captures, "prior: jely\n")
    config = loaded(captures)
    (problem,) = {line.partition(": ")[2] for line in checks.local_problems(config)}
    assert "no prior 'jely'" in problem and not checks.problems(config)


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("logs", "reserved"),
        ("a.b", "letters"),
        ("my mug", "letters"),
        ("m\u00fcg", "letters"),
        ("mug_one", "mug_one"),
    ],
)
def test_captures_whose_names_are_taken_are_left_out(captures, name, problem):
    (captures / name).mkdir()
    (captures / name / "capture.yaml").write_text("board: {square: 0.03}\n")
    broken = []
    assert {"mug", "mug_one", "mug_two"} == captured_scenes(captures, log=broken.append).keys()
    assert [problem in str(error) for error in broken] == [True]


def test_a_released_capture_that_is_missing_leaves_other_scenes_usable(captures):
    broken = []
    missing = {"bun": ReleasedConfig(folder=str(captures / "nowhere"))}
    assert {"mug", "mug_one", "mug_two"} == captured_scenes(captures, missing, log=broken.append).keys()
    assert "nowhere" in broken[0].where


def test_the_truth_of_a_capture_is_unknown(captures):
    config = loaded(captures)
    with pytest.raises(InputError, match=NO_TRUTH):
        config.frame_steps("mug_one")
    with pytest.raises(InputError, match=NO_TRUTH):
        cases.case(config, "mug_one", "true_law").source()


def test_two_scenes_of_one_name(captures):
    with refused("scenes.BouncyBall"):
        load({}, captured={"BouncyBall": captured_scenes(captures)["mug"]})


def test_other_scenes_need_a_truth():
    with pytest.raises(InputError, match="law: null is for scenes of captures only"):
        load({"scenes": {"BouncyBall": {"law": None}}})


def test_rows_are_read_in_turn():
    frames = [{"time": 0.1 * k, "h": 50} for k in range(3)]
    mattes = np.zeros((3, 50, 4, 4), np.uint8)
    mattes[range(3), (0, 24, 49)] = 255  # centres at half integers
    times = frame_times(frames, mattes, 1e-5, 1000)
    np.testing.assert_allclose(times, [0.0001, 0.1049, 0.2099])


def test_frames_are_spread_over_the_time_after_the_start():
    times = np.arange(-10, 90) / 100
    chosen = chosen_frames(times, 0.5, 11, "one, left")
    np.testing.assert_allclose(times[chosen], np.arange(11) / 20)
    assert len(chosen_frames(times, 0.5, 999, "one, left")) == 51
    with pytest.raises(InputError, match="one, left: 6 frames"):
        chosen_frames(times, 0.05, 60, "one, left")


def test_reduced_pictures_keep_coverage_and_colour_and_nothing_of_the_background():
    rgba = np.zeros((40, 80, 4), np.uint8)
    rgba[..., :3] = (10, 250, 90)  # under the background
    rgba[8:24, 13:51] = (200, 100, 50, 255)
    small = reduced(rgba, 20)
    assert small.shape == (10, 20, 4)
    assert small[..., 3].sum() / 255 * 16 == pytest.approx(16 * 38, rel=0.01)
    assert (small[small[..., 3] > 0][:, :3] == (200, 100, 50)).all()
    assert not small[small[..., 3] == 0].any()
    assert reduced(rgba, 100) is rgba


def test_reduced_labels_are_those_of_the_largest_share():
    """Of blocks of 4 x 4 pixels. A block that bodies cover by less than half has none."""
    labels = np.zeros((8, 12), np.uint8)
    labels[:4, :4] = 2
    labels[:4, :1] = 1
    labels[:4, 4:7], labels[:2, 4:7] = 1, 3
    labels[2:4, 5:7] = 3
    labels[4:, :1] = 2
    labels[4:, 4:5], labels[4:, 5:6] = 1, 2
    labels[4:6, 6:7] = 2
    np.testing.assert_array_equal(reduced_labels(labels, (3, 2), 3), [[2, 3, 0], [0, 2, 0]])


def test_a_point_stays_on_its_part_of_a_reduced_picture():
    frame = {"fl_x": 70.0, "fl_y": 72.0, "cx": 41.0, "cy": 19.0, "w": 80, "h": 40}
    small = reduced_intrinsics(frame, (20, 10))
    for axis, focal, centre, size in (("x", "fl_x", "cx", 80), ("y", "fl_y", "cy", 40)):
        seen, seen_small = (f[focal] * 0.3 + f[centre] for f in (frame, small))
        assert seen_small / (size / 4) == pytest.approx(seen / size), axis


def test_the_gain_of_a_camera_is_divided_out():
    rgba = np.array([[[100, 80, 250, 255], [0, 0, 0, 0]]], np.uint8)
    corrected = without_gain(rgba, (0.5, 1.0, 0.8))
    np.testing.assert_array_equal(corrected[0, 0], [200, 80, 255, 255])
    np.testing.assert_array_equal(rgba[0, 0], [100, 80, 250, 255])
