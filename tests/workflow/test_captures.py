"""Own photographs and videos, from a folder of drawn pictures to the page of their checks, by real Snakemake runs."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from neuma_lib.errors import InputError
from neuma_lib.io.images import read_transforms
from neuma_lib.project.capture_folder import read_capture
from neuma_lib.project.capture_scenes import captured_scenes
from neuma_lib.project.loading import load, read_yaml
from tests.support.board_pictures import LENS, around, picture
from tests.support.errors import refused
from tests.support.films import film
from tests.support.project import copied

PAGE = "tiny/results/mug/capture.md"
BOARD_ALONE = "board: {square: 0.03}\nposes: board\nlens: lenses.json\nadvanced: {longest: 400}\n"


@pytest.fixture
def project(tmp_path, kernels):
    return copied(tmp_path / "project", kernels)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """A capture of four photographs, one camera, its still and its video; cameras are found from the board."""
    pytest.importorskip("cv2")
    root = tmp_path_factory.mktemp("drawn") / "mug"
    for name, pose in zip(("photos/a", "photos/b", "photos/c", "photos/d", "stills/left"), around(5)):
        file = root / f"{name}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.repeat(picture(pose, samples=2)[..., None], 3, axis=2)).save(file)
    (root / "videos").mkdir()
    film(root / "videos/left.mp4", [3000 * k for k in range(8)])
    (root / "lenses.json").write_text(json.dumps({"photographs": LENS.plain(), "left": LENS.plain()}))
    (root / "capture.yaml").write_text(BOARD_ALONE + "cameras: {left: {rate: 240}}\n")
    return root


@pytest.fixture
def mug(project, drawn):
    """The capture in the project."""
    return shutil.copytree(drawn, project.root / "captures/mug")


def test_from_pictures_to_the_page(project, mug):
    """Every stage leaves an image; a setting repeats what depends on it and no more."""
    output = project.run(PAGE, "captures/board.pdf")
    assert "5 of 5 pictures registered" in output and "8 frames, 240.00 per second" in output
    assert (project.root / "captures/board.pdf").read_bytes().startswith(b"%PDF")
    page = (project.root / PAGE).read_text()
    assert "| pictures with a place | 5 of 5 | all | ok |" in page and "look" not in page
    assert (
        "| frames of first, left | 8 at 240.00 a second, slowed 8 times in the file | none missing | ok |"
        in page
    )
    for file in ("poses.png", "cameras.png", "floor.png", "frames/first/left.png"):
        with Image.open((project.root / PAGE).parent / file) as image:
            assert image.width > 500
        assert file == "poses.png" or f"({file})" in page
    data = read_transforms(project.root / "tiny/data/mug/room/transforms.json")
    assert [frame["group"] for frame in data["frames"]] == ["photographs"] * 4 + ["left"]
    (mug / "capture.yaml").write_text(BOARD_ALONE + "cameras: {left: {rate: 240}}\ncenter: [0.1, 0.1]\n")
    assert set(project.plan(PAGE, "captures/board.pdf")) == {"capture_room", "capture_page"}
    (mug / "capture.yaml").write_text(BOARD_ALONE + "cameras: {left: {rate: 120}}\n")
    assert set(project.plan(PAGE)) == {"capture_frames", "capture_page"}


def test_problems_are_named_before_anything_runs(project, mug):
    def refusal(target=PAGE):
        output = project.run(target, succeeds=False)
        assert not (project.root / "tiny").exists(), "something ran"
        return output

    assert "no take 'second'; known: first" in refusal("tiny/results/mug/frames/second/left.json")
    (mug / "stills/left.png").rename(mug / "stills/right.png")
    assert "no picture of the empty scene for the camera 'left'" in refusal()
    (mug / "capture.yaml").write_text("board: {square: 0.03, sqares: [6, 8]}\n")
    assert "captures/mug/capture.yaml: board.sqares: unknown key; did you mean squares" in refusal()


def test_problems_of_folders_are_found_where_captures_are_read(project, mug):
    """Of other problems, the test above shows that the workflow passes the message on."""
    folder = project.root / "captures"
    with refused(folder / "cup/capture.yaml") as caught:
        read_capture(folder / "cup")
    assert "does not exist" in str(caught.value)
    (mug / "capture.yaml").write_text(BOARD_ALONE.replace("lenses.json", "../lenses.json"))
    with pytest.raises(InputError, match="the path must be relative and inside the folder of the capture"):
        read_capture(mug)
    (mug / "capture.yaml").write_text(BOARD_ALONE)
    mug.rename(mug.with_name("BouncyBall"))
    settings = read_yaml(project.root / "config/config.yaml")
    with refused("scenes.BouncyBall") as caught:
        load(settings, project.root, captured=captured_scenes(folder))
    assert "a capture has a scene of this name" in str(caught.value)


def test_a_failing_stage_leaves_nothing_half_written(project, mug):
    (mug / "photos/a.png").write_text("no picture")
    (mug / "videos/left.mp4").write_text("no video")
    targets = ("tiny/results/mug/poses.json", "tiny/results/mug/frames/first/left.json")
    output = project.run("--keep-going", *targets, succeeds=False)
    assert "photos/a.png: cannot be read as an image" in output
    assert "left.mp4: cannot be read as a video" in output and "Traceback" not in output
    files = (project.root / "tiny/results/mug").rglob("*")
    assert not [file for file in files if file.is_file()]
