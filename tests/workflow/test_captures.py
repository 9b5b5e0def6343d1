"""Own photographs and videos, from a folder of drawn pictures to the page of their checks, by real Snakemake runs."""

import json

import numpy as np
import pytest
from PIL import Image

from neuma_lib.io.images import read_transforms
from tests.support.board_pictures import LENS, around, picture
from tests.support.films import film
from tests.support.project import copied

PAGE = "tiny/results/mug/capture.md"
BOARD_ALONE = "board: {square: 0.03}\nposes: board\nlens: lenses.json\nadvanced: {longest: 400}\n"


@pytest.fixture
def project(tmp_path):
    return copied(tmp_path / "project", tmp_path / "kernels")


@pytest.fixture
def mug(project):
    """A capture of four photographs, one camera, its still and its video; cameras are found from the board."""
    pytest.importorskip("cv2")
    root = project.root / "captures/mug"
    for name, pose in zip(("photos/a", "photos/b", "photos/c", "photos/d", "stills/left"), around(5)):
        file = root / f"{name}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.repeat(picture(pose, samples=2)[..., None], 3, axis=2)).save(file)
    (root / "videos").mkdir()
    film(root / "videos/left.mp4", [3000 * k for k in range(8)])
    (root / "lenses.json").write_text(json.dumps({"photographs": LENS.plain(), "left": LENS.plain()}))
    (root / "capture.yaml").write_text(BOARD_ALONE + "cameras: {left: {rate: 240}}\n")
    return root


def test_from_pictures_to_the_page(project, mug):
    """Every stage leaves something to look at; a setting repeats what depends on it and no more."""
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
        with Image.open((project.root / PAGE).parent / file) as shown:
            assert shown.width > 500
        assert file == "poses.png" or f"({file})" in page
    data = read_transforms(project.root / "tiny/data/mug/room/transforms.json")
    assert [frame["group"] for frame in data["frames"]] == ["photographs"] * 4 + ["left"]
    assert project.plan(PAGE, "captures/board.pdf") == {}
    (mug / "capture.yaml").write_text(BOARD_ALONE + "cameras: {left: {rate: 240}}\ncenter: [0.1, 0.1]\n")
    assert set(project.plan(PAGE)) == {"capture_room", "capture_page"}
    (mug / "capture.yaml").write_text(BOARD_ALONE + "cameras: {left: {rate: 120}}\n")
    assert set(project.plan(PAGE)) == {"capture_frames", "capture_page"}


def test_what_is_wrong_is_said_before_anything_runs(project, mug):
    def refusal(target=PAGE):
        output = project.run(target, succeeds=False)
        assert "capture_" not in "".join(p.name for p in (project.root / "tiny").rglob("*")), "something ran"
        return output

    assert "captures/cup/capture.yaml: does not exist" in refusal("tiny/results/cup/capture.md")
    assert "no take 'second'; known: first" in refusal("tiny/results/mug/frames/second/left.json")
    (mug / "capture.yaml").write_text("board: {square: 0.03, sqares: [6, 8]}\n")
    assert "captures/mug/capture.yaml: board.sqares: unknown key; did you mean squares" in refusal()
    (mug / "capture.yaml").write_text(BOARD_ALONE.replace("lenses.json", "../lenses.json"))
    assert "the path must be relative and inside the folder of the capture" in refusal()
    (mug / "capture.yaml").write_text(BOARD_ALONE)
    (mug / "stills/left.png").rename(mug / "stills/right.png")
    assert "no picture of the empty scene for the camera 'left'" in refusal()
    mug.rename(mug.with_name("BouncyBall"))
    assert "scenes.BouncyBall: a capture has a scene of this name" in refusal()


def test_a_failing_stage_leaves_nothing_half_written(project, mug):
    (mug / "photos/a.png").write_text("no picture")
    said = project.run("tiny/results/mug/poses.json", succeeds=False)
    assert "photos/a.png: cannot be read as an image" in said and "Traceback" not in said
    (mug / "videos/left.mp4").write_text("no video")
    said = project.run("tiny/results/mug/frames/first/left.json", succeeds=False)
    assert "left.mp4: cannot be read as a video" in said
    made = (project.root / "tiny/results/mug").rglob("*")
    assert not [file for file in made if file.is_file()]
