"""Scenes written for other systems, read back by the readers of these layouts; and scores of predicted positions."""

import csv
import io
import json
import re
import shutil
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from PIL import Image

from neuma_lib.cli import main
from neuma_lib.evaluation.metrics import tracer_errors
from neuma_lib.evaluation.scoring import score_positions
from neuma_lib.geometry.chamfer import chamfer_sequence
from neuma_lib.io.datasets.benchmark import LAYOUTS, PARTS, frame_numbers, write_scene
from neuma_lib.io.datasets.layouts import take_video
from neuma_lib.io.files import read_json
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.io.images import list_images, read_image_set
from neuma_lib.io.ply import write_ply
from neuma_lib.io.positions import read_positions, write_points
from tests.support.errors import refused
from tests.support.image_layouts import write_pac_nerf, write_spring_gaus

pytestmark = pytest.mark.core

ROOT = Path(__file__).resolve().parents[2]
STEPS = (0, 10, 20, 30)
LAW = {"elasticity": {"name": "hencky", "E": 12345.0, "nu": 0.3}}
POINTS = 200


def motion(seed):
    """A falling cloud of points (T, M, 3) in a cube of 0.2 m."""
    x = 0.2 * np.random.default_rng(seed).random((POINTS, 3)) + [0.4, 0.5, 0.4]
    return np.stack([x - [0.0, 0.001 * step, 0.0] for step in STEPS]).astype(np.float32)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Folder of a scene's data as the workflow has it."""
    folder = tmp_path_factory.mktemp("data") / "Ball"
    source, _ = write_pac_nerf(folder / "set", frames=4)
    take_video(source, folder / "dynamic/transforms.json", STEPS, 10)
    source, _ = write_spring_gaus(folder / "photographs", cameras=5, frames=1)
    take_video(source, folder / "static/transforms.json", [0], 1)
    arrays = {"tracers": motion(0), "tracers_again": motion(1), "x": motion(2), "frames": np.array(STEPS)}
    times = {"time": 1e-3 * np.array(STEPS)}
    write_arrays(folder / "truth.h5", arrays | times, {"dt": 1e-3, "bodies": [{"law": LAW}]})
    return folder


def read_back(layout, folder, target):
    """Photographs and video as the readers of our project see them."""
    if layout == "neuma":
        return [
            list_images(folder / f"data_{part}.json", target / part / "transforms.json") for part in PARTS
        ]
    listed = folder / {"pac_nerf": "all_data.json", "spring_gaus": "camera.json"}[layout]
    video = take_video(listed, target / "transforms.json", STEPS, 10, offset=(0.0, 0.0, 0.0))
    return read_image_set(folder / "static/transforms.json"), video


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_written_scene_is_read_back_exactly(data, tmp_path, layout):
    """Every pixel, camera, view and step of photographs and video, and the true motion."""
    write_scene(layout, data, tmp_path / "out", "Ball", {"density": 1000.0})
    for part, images in zip(PARTS, read_back(layout, tmp_path / "out/Ball", tmp_path), strict=True):
        original = read_image_set(data / part / "transforms.json")
        order = [np.lexsort((each.views, each.steps)) for each in (original, images)]
        for name in ("images", "viewmats", "Ks", "views", "steps"):
            before, after = (getattr(each, name)[rows] for each, rows in zip((original, images), order))
            assert np.array_equal(before, after), (part, name)
    truth, about = read_arrays(tmp_path / "out/truth/Ball.h5")
    assert np.array_equal(truth["tracers"], motion(0)) and np.array_equal(truth["tracers_again"], motion(1))
    assert about["scene"] == "Ball" and json.loads(about["bodies"])[0]["law"] == LAW
    assert "x" not in truth, "particles are no measure"
    starts, _ = read_positions([tmp_path / "out/Ball/starts.ply"])
    assert np.array_equal(starts[0], motion(0)[0])
    assert "creativecommons.org/licenses/by/4.0" in (tmp_path / "out/LICENSE").read_text()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_truth_is_in_its_own_folder(data, tmp_path, layout):
    """No file of the scene states the law, or has the motion after the first frame."""
    write_scene(layout, data, tmp_path, "Ball", {"density": 1000.0})
    known = read_json(tmp_path / "Ball/scene.json")
    assert known["density"] == 1000.0 and known["frames"] == list(STEPS)
    assert known["time"] == pytest.approx([0.0, 0.01, 0.02, 0.03])
    later = motion(0)[1:].tobytes()[:24]
    for file in (tmp_path / "Ball").rglob("*"):
        if file.is_file():
            content = file.read_bytes()
            assert b"12345" not in content and b"hencky" not in content and later not in content, file


def test_pac_nerf_has_mattes_and_backgrounds(data, tmp_path):
    """On white, so that the mask of a matte is that of the image, up to parts of pixels."""
    write_scene("pac_nerf", data, tmp_path, "Ball", {})
    for file in (tmp_path / "Ball/data").glob("r_*_[0-9].png"):
        file.unlink()
        shutil.copy(file.with_name(f"m{file.name[1:]}"), file)
    target = tmp_path / "again/transforms.json"
    images = take_video(tmp_path / "Ball/all_data.json", target, STEPS, 10, offset=(0, 0, 0))
    original = read_image_set(data / "dynamic/transforms.json")
    inside = original.images[..., 3] > 0
    assert np.array_equal(images.images[inside], original.images[inside])
    assert not images.images[~inside, 3].any()


def test_the_code_of_pac_nerf_can_read_its_layout(data, tmp_path):
    """It needs poses (3, 4), one background a camera, and colours that equal the background outside of the body."""
    write_scene("pac_nerf", data, tmp_path, "Ball", {})
    entries = read_json(tmp_path / "Ball/all_data.json")
    numbers = [tuple(map(int, Path(entry["file_path"]).stem.split("_")[1:])) for entry in entries]
    assert sorted(numbers) == [(camera, frame) for camera in range(3) for frame in range(-1, 4)]
    assert all(np.shape(entry["c2w"]) == (3, 4) for entry in entries)
    pixels = {n: np.asarray(Image.open(tmp_path / "Ball" / e["file_path"])) for n, e in zip(numbers, entries)}
    for (camera, frame), image in pixels.items():
        if frame >= 0:
            outside = image[..., 3] == 0
            assert np.array_equal(image[outside, :3], pixels[camera, -1][outside])


def test_frames_of_shipped_scenes_can_be_counted(loaded):
    scenes = [*loaded.tables["table1"].scenes, *loaded.random_scenes]
    assert len(scenes) == 18 and all(len(frame_numbers(loaded.frame_steps(name))) == 33 for name in scenes)


def test_frames_that_cannot_be_counted_and_folders_that_exist_are_refused(data, tmp_path):
    uneven = tmp_path / "uneven"
    shutil.copytree(data, uneven)
    listed = uneven / "dynamic/transforms.json"
    content = json.loads(listed.read_text())
    for frame in content["frames"]:
        frame["step"] = {20: 15}.get(frame["step"], frame["step"])
    listed.write_text(json.dumps(content))
    with refused("frames", problem="evenly spaced", remedy="neuma"):
        write_scene("pac_nerf", uneven, tmp_path / "out", "Ball", {})
    assert not (tmp_path / "out").exists()
    write_scene("neuma", uneven, tmp_path / "out", "Ball", {})
    with refused("out/Ball", remedy="--out"):
        write_scene("neuma", uneven, tmp_path / "out", "Ball", {})
    with refused("nothing/truth.h5", problem="does not exist"):
        write_scene("neuma", tmp_path / "nothing", tmp_path / "other", "Ball", {})


def test_the_command_writes_and_scores(data, tmp_path, monkeypatch, capsys):
    shutil.copytree(ROOT / "config", tmp_path / "config")
    shutil.copytree(data, tmp_path / "data/BouncyBall")
    monkeypatch.chdir(tmp_path)
    assert main(["dataset", "--layout", "spring_gaus", "--out", "out", "BouncyBall"]) == 0
    known = read_json("out/BouncyBall/scene.json")
    assert (known["dt"], known["density"], known["grid"]) == (1e-3, 1000.0, 36)
    assert known["gravity"] == [0.0, -9.8, 0.0]
    assert main(["dataset", "--layout", "neuma", "--out", "more", "BouncyBal"]) == 1
    assert main(["dataset", "--layout", "neuma", "--out", "more"]) == 1  # the others are not rendered
    assert "did you mean BouncyBall" in (errors := capsys.readouterr().err)
    scene = "data/random7_11_cat_neo_hookean"  # seed and count of config.yaml
    assert "51 files of the scenes do not exist" in errors and f"{scene}/truth.h5 {scene}/static/" in errors
    shutil.copytree(ROOT / "docs/results", "docs/results", ignore=shutil.ignore_patterns("figures", "gpu"))
    np.savez("mine.npz", x=motion(0) + np.float32([3e-3, 0, 4e-3]) * (np.array(STEPS) > 0)[:, None, None])
    assert main(["score", "mine.npz", "--truth", "out/truth/BouncyBall.h5"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "BouncyBall: 4 frames, 200 points, compared with docs/results/table1.csv"
    (rmse,) = (line for line in lines if line.startswith("  tracer_rmse "))
    assert float(rmse.split()[1]) == pytest.approx(5 * 0.75**0.5, abs=1e-3)
    with open("docs/results/table1.csv") as file:
        rows = [row for row in csv.DictReader(file) if row["quantity"] == "tracer_rmse_mm"]
    errors = sorted((float(row["BouncyBall"]), row["title"]) for row in rows)
    better = [entry for entry in errors if entry[0] < 5 * 0.75**0.5]
    place = (
        f"place {len(better) + 1} of {len(errors) + 1} (behind {better[-1][1]} {better[-1][0]:.3g}, ahead of "
    )
    assert place in rmse and errors[len(better)][1] in rmse
    assert (
        main(
            ["score", "mine.npz", "--truth", "data/BouncyBall/truth.h5", "--table", "docs/results/random.csv"]
        )
        == 1
    )
    assert "has no methods in the scene BouncyBall" in capsys.readouterr().err


def test_random_scenes_have_their_place_in_their_table():
    from neuma_lib.paper import ranking

    with open(ROOT / "docs/results/random.csv") as file:
        scene = next(csv.DictReader(file))["scene"]
    table = ranking.find_table(ROOT / "docs/results", scene)
    values = ranking.recorded(table, scene)
    assert table.name == "random.csv" and values.keys() == {"tracer_rmse_mm"}
    assert {"nclaw", "neuma", "constants", "true_law"} <= values["tracer_rmse_mm"].keys()
    text = ranking.places({"tracer_rmse_mm": 0.0}, values)["tracer_rmse_mm"]
    count = len(values["tracer_rmse_mm"]) + 1
    assert text.startswith(f"place 1 of {count} (ahead of ") and "behind" not in text
    assert "ahead" not in ranking.places({"tracer_rmse_mm": 1e9}, values)["tracer_rmse_mm"]
    assert ranking.find_table(ROOT / "docs/results", "nowhere") is None


# ---- scores


def sets():
    return [torch.from_numpy(motion(seed)).double() for seed in (0, 1)]


def test_scores_are_the_measures_of_evaluations():
    """Tracers are compared one by one in any order, and other points by the Chamfer distance alone."""
    truth, again = sets()
    moved = truth + torch.tensor([0.0, 0.002, 0.0]) * (torch.arange(4) > 0)[:, None, None]
    errors = tracer_errors(moved, truth)
    shuffled = moved[:, torch.randperm(POINTS, generator=torch.Generator().manual_seed(0))]
    alone = score_positions(shuffled, truth, again)
    assert alone["tracer_rmse_mm"] == pytest.approx(errors["tracer_rmse_mm"]) == pytest.approx(2 * 0.75**0.5)
    expected = chamfer_sequence(moved, again).mean(), chamfer_sequence(truth, again).mean()
    assert (alone["chamfer"], alone["chamfer_floor"]) == pytest.approx(tuple(map(float, expected)))
    own = torch.from_numpy(motion(3)).double()
    both = score_positions(torch.cat([own, moved], dim=1), truth, again, STEPS, STEPS)
    assert both["tracer_rmse_mm"] == pytest.approx(errors["tracer_rmse_mm"])
    chamfer, floor = (float(chamfer_sequence(x, truth).mean()) for x in (own, again))
    assert (both["chamfer"], both["chamfer_floor"]) == pytest.approx((chamfer, floor))
    assert both["chamfer_excess"] == pytest.approx(chamfer - floor) and both["points"] == POINTS
    without = score_positions(own, truth, again)
    assert "tracer_rmse_mm" not in without and without["chamfer"] == pytest.approx(chamfer)


def test_the_floor_is_of_as_many_points_as_the_prediction():
    """A prediction with the true distribution has no excess, however many points it has, up to sampling."""
    truth, again = sets()
    many = torch.cat([torch.from_numpy(motion(seed)).double() for seed in range(4, 12)], dim=1)
    scores = {count: score_positions(many[:, :count], truth, again) for count in (100, 200, 1600)}
    assert [score["points"] for score in scores.values()] == [100, 200, 200]
    floors = [score["chamfer_floor"] for score in scores.values()]
    assert floors[0] > 1.2 * floors[1] and floors[1] == pytest.approx(floors[2])
    for count, score in scores.items():
        # r^2 to the nearest neighbour deviates by 0.68 of its mean: three standard deviations of the difference of two.
        assert abs(score["chamfer_excess"]) < 3 * 0.68 * score["chamfer"] * (2 / min(count, POINTS)) ** 0.5
    with refused("positions", problem="99 points are fewer than 100", remedy="starts.ply"):
        score_positions(many[:, :99], truth, again)


@pytest.mark.parametrize("kind", ["npz", "h5", "ply", "folder", "tracers"])
def test_positions_are_read_from_every_format(tmp_path, kind):
    x, frames = motion(0), np.array(STEPS)
    if kind == "npz":
        np.savez_compressed(tmp_path / "a.npz", x=x.astype(np.float64), frames=frames, other=["text"])
        files = [tmp_path / "a.npz"]
    elif kind in ("h5", "tracers"):
        arrays = {"x": x if kind == "h5" else motion(7), "frames": frames}
        write_arrays(tmp_path / "a.h5", arrays | ({"tracers": x} if kind == "tracers" else {}))
        files = [tmp_path / "a.h5"]
    else:
        files = [
            tmp_path / f"f_{10 * k}.ply" for k in range(4)
        ]  # "f_10" would be sorted before "f_2" as a text
        for file, points in zip(files, x, strict=True):
            write_points(file, points)
        files = [tmp_path] if kind == "folder" else files[::-1]
    read, steps = read_positions(files)
    assert np.array_equal(read, x) and read.dtype == np.float64
    assert steps is None if kind in ("ply", "folder") else np.array_equal(steps, frames)


def h5(**arrays):
    def write(folder):
        with h5py.File(folder / "a.h5", "w") as file:
            for name, values in arrays.items():
                file[name] = values
        return ["a.h5"]

    return write


def npz(**arrays):
    def write(folder):
        np.savez(folder / "a.npz", **arrays)
        return ["a.npz"]

    return write


def raw(name, content):
    def write(folder):
        (folder / name).write_bytes(content)
        return [name]

    return write


def plys(*frames, names="f_{}.ply"):
    def write(folder):
        files = [names.format(k) for k in range(len(frames))]
        for file, points in zip(files, frames, strict=True):
            write_points(folder / file, points)
        return files

    return write


def truncated(writer, keep):
    def write(folder):
        files = writer(folder)
        path = folder / files[0]
        path.write_bytes(path.read_bytes()[:keep])
        return files

    return write


def no_depth(folder):
    write_ply(folder / "f_0.ply", np.zeros(9, dtype=[("x", "<f4"), ("y", "<f4")]))
    return ["f_0.ply"]


def huge_claim(folder):
    """An array whose header claims 2^60 points."""
    content = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": (4, 2**60, 3)}
    np.lib.format.write_array_header_1_0(content, header)
    with zipfile.ZipFile(folder / "a.npz", "w") as archive:
        archive.writestr("x.npy", content.getvalue())
    return ["a.npz"]


def compressed(folder):
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("x", data=motion(0), compression="gzip")
    return ["a.h5"]


def spoilt(value):
    x = motion(0).copy()
    x[1, 7, 2] = value
    return x


MALFORMED = {
    "missing": lambda folder: ["nothing.h5"],
    "empty folder": lambda folder: ["."],
    "other suffix": raw("a.csv", b"1,2,3\n"),
    "mixed suffixes": lambda folder: [*npz(x=motion(0))(folder), *plys(motion(0)[0])(folder)],
    "two archives": lambda folder: [*npz(x=motion(0))(folder), *h5(x=motion(0))(folder)],
    "empty npz": raw("a.npz", b""),
    "no zip": raw("a.npz", b"not an archive"),
    "cut npz": truncated(npz(x=motion(0)), 600),
    "no array": npz(y=motion(0)),
    "pickled": npz(x=np.array([{"a": 1}], dtype=object)),
    "text": npz(x=np.array([["a"]])),
    "complex": npz(x=motion(0).astype(complex)),
    "one state": npz(x=motion(0)[0]),
    "four columns": npz(x=np.zeros((4, POINTS, 4))),
    "no points": npz(x=np.zeros((4, 0, 3))),
    "huge claim": huge_claim,
    "not finite": npz(x=spoilt(np.nan)),
    "infinite": npz(x=spoilt(np.inf)),
    "millimetres": npz(x=1e3 * motion(0)),
    "frames of another length": npz(x=motion(0), frames=np.array([0, 10])),
    "frames as times": npz(x=motion(0), frames=1e-3 * np.array(STEPS)),
    "other frames": npz(x=motion(0), frames=np.array([0, 10, 20, 40])),
    "fewer frames": npz(x=motion(0)[:3]),
    "few points": npz(x=motion(3)[:, :50]),
    "no hdf5": raw("a.h5", b"\x89HDF\r\n\x1a\n"),
    "cut hdf5": truncated(h5(x=motion(0)), 900),
    "hdf5 without x": h5(v=motion(0)),
    "hdf5 not finite": h5(x=spoilt(np.nan)),
    "hdf5 of one state": h5(x=motion(0)[0]),
    "hdf5 compressed": compressed,
    "no ply": raw("f_0.ply", b"plys\n"),
    "cut ply": truncated(plys(*motion(0)), 300),
    "ply without z": no_depth,
    "ply of other counts": plys(*motion(0)[:3], motion(0)[3, :-1]),
    "ply without numbers": lambda folder: [
        *plys(motion(0)[0], names="a.ply")(folder), *plys(motion(0)[1], names="b.ply")(folder)
    ],
    "ply not finite": plys(motion(0)[0], spoilt(np.nan)[1]),
}  # fmt: skip


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed_files_have_one_line_each(data, tmp_path, monkeypatch, capsys, case):
    monkeypatch.chdir(tmp_path)
    files = MALFORMED[case](tmp_path)
    assert main(["score", *files, "--truth", str(data / "truth.h5")]) == 1
    output = capsys.readouterr()
    (line,) = output.err.splitlines()
    assert re.match(r"ERROR: (\./)?[\w*.]+(:.*)? ?", line) and not output.out, line
    assert any(Path(file).name in line for file in files) or case == "empty folder", line
    assert len(line) < 400 and "Traceback" not in line
