"""Settings and files of a capture."""

import signal
import subprocess
import sys

import pytest

from neuma_lib.capture import tools
from neuma_lib.errors import InputError
from neuma_lib.project import capture_folder
from tests.support.errors import refused

MINIMAL = "board: {square: 0.0298}\n"


@pytest.fixture
def mug(tmp_path):
    """A complete capture of empty files."""
    root = tmp_path / "mug"
    for name in ("photos/b.jpg", "photos/a.JPG", "photos/.hidden.jpg", "photos/notes.txt", "stills/left.jpg",
                 "stills/right.png", "videos/right.mp4", "videos/left.MOV"):  # fmt: skip
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    (root / "capture.yaml").write_text(MINIMAL)
    return root


def refusal(root, text=None):
    if text is not None:
        (root / "capture.yaml").write_text(text)
    with pytest.raises(InputError) as error:
        capture_folder.read_capture(root)
    return str(error.value)


def test_one_line_suffices_and_all_files_are_read(mug):
    capture = capture_folder.read_capture(mug)
    assert [p.name for p in capture.photographs] == ["a.JPG", "b.jpg"]
    assert {c: p.name for c, p in capture.stills.items()} == {"left": "left.jpg", "right": "right.png"}
    assert {t: list(v) for t, v in capture.takes.items()} == {"first": ["left", "right"]}
    assert list(capture.pictures()) == ["photographs", "left", "right"]
    assert capture.video("first", "left").name == "left.MOV"
    assert capture.settings.board.square == 0.0298 and capture.settings.board.squares == (6, 8)


def test_folders_of_videos_are_takes(mug):
    for take in ("one", "two"):
        (mug / "videos" / take).mkdir()
    for camera in ("left.MOV", "right.mp4"):
        (mug / "videos" / camera).rename(mug / "videos" / "one" / camera)
    (mug / "videos/two/left.mp4").touch()
    takes = capture_folder.read_capture(mug).takes
    assert {t: list(v) for t, v in takes.items()} == {"one": ["left", "right"], "two": ["left"]}
    (mug / "videos/right.mp4").touch()
    with refused(mug / "videos"):
        capture_folder.read_capture(mug)


@pytest.mark.parametrize(
    "name", ["../photos", "/etc", "a/../../b", "~/photos", "C:\\photos", "..\\photos", " "]
)
def test_paths_stay_in_the_folder(mug, name):
    message = refusal(mug, MINIMAL + f"photographs: '{name}'\n")
    assert "capture.yaml: photographs:" in message


def test_links_stay_in_the_folder(mug, tmp_path):
    outside = tmp_path / "outside.jpg"
    outside.touch()
    (mug / "photos/c.jpg").symlink_to(outside)
    with refused(mug / "photos/c.jpg"):
        capture_folder.read_capture(mug)
    (mug / "photos/c.jpg").unlink()
    (mug / "photos/c.jpg").symlink_to(mug / "photos/b.jpg")
    assert len(capture_folder.read_capture(mug).photographs) == 3


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("object: {a.JPG: [10, 10, 12, 90]}\n", ["object.a.JPG"]),
        ("object: {c.jpg: [10, 10, 90, 90]}\n", ["object.c.jpg"]),
        ("board: {}\n", ["board.square"]),
        ("board: {square: 30}\n", ["board.square"]),
        ("board: {square: 0.03, sqares: [6, 8]}\n", ["board.sqares", "squares"]),
        ("board: {square: 0.03, squares: [2, 8]}\n", ["board", "3"]),
        ("board: {square: 0.03}\nposes: board\n", ["lens"]),
        ("length: {metres: 1}\n", ["length", "ends"]),
        ("length: {metres: 1, cameras: [a.JPG, c.jpg]}\n", ["length.cameras.c.jpg"]),
        (
            "length: {metres: 1, ends: {a.JPG: [[0, 0], [1, 1]], c.jpg: [[0, 0], [1, 1]]}}\n",
            ["length.ends.c.jpg"],
        ),
        (
            MINIMAL + "length: {metres: 1, ends: {a.JPG: [[0, 0], [1, 1]], b.jpg: [[0, 0], [1, 1]]}}\n",
            ["length", "board"],
        ),
        ("poses: t.json\ncenter: [0, 0]\n", ["center"]),
        (MINIMAL + "cameras: {lefft: {rate: 240}}\n", ["cameras.lefft", "mean left"]),
        (MINIMAL + "cameras: {left: {rate: 0}}\n", ["cameras.left.rate"]),
        (MINIMAL + "throws: {one: {folder: none}}\n", ["none: no videos"]),
        ("board: [", ["YAML"]),
        ("- 1\n", ["capture.yaml"]),
    ],
)
def test_messages_name_file_and_key(mug, text, words):
    message = refusal(mug, text)
    assert "capture.yaml" in message or "none" in message
    assert all(word in message for word in words), message


def test_what_is_missing_is_named(mug):
    (mug / "stills/left.jpg").unlink()
    with refused(mug / "stills"):
        capture_folder.read_capture(mug).pictures()
    (mug / "capture.yaml").unlink()
    with refused(mug / "capture.yaml"):
        capture_folder.read_capture(mug)


def test_photographs_and_videos_can_come_one_after_the_other(mug):
    """A missing file is an error only where it is needed."""
    (mug / "videos").rename(mug / "later")
    photographed = capture_folder.read_capture(mug)
    assert list(photographed.pictures()) == ["photographs", "left", "right"] and photographed.takes == {}
    with refused(mug / "videos"):
        photographed.video("first", "left")
    (mug / "later").rename(mug / "videos")
    (mug / "photos").rename(mug / "elsewhere")
    filmed = capture_folder.read_capture(mug)
    with refused(mug / "photos"):
        filmed.pictures()
    with refused(problem="no take 'second'"):
        filmed.video("second", "left")
    with refused(problem="did you mean left"):
        filmed.video("first", "lefft")


def test_names_of_cameras_can_name_results(mug):
    for file in ("videos/left.MOV", "stills/left.jpg"):
        (mug / file).rename((mug / file).with_stem("left {0}"))
    assert "'left {0}'" in refusal(mug)


def test_ambiguous_and_unreadable_files(mug):
    (mug / "videos/left.mp4").touch()
    with refused(mug / "videos/left"):
        capture_folder.read_capture(mug)
    (mug / "videos/left.mp4").unlink()
    (mug / "photos/b.png").touch()
    with refused(mug / "photos/b."):
        capture_folder.read_capture(mug)
    (mug / "photos/b.png").unlink()
    for name in ("videos/left.MOV", "stills/left.jpg"):
        (mug / name).rename((mug / name).with_stem("photographs"))
    assert "'photographs'" in refusal(mug)
    (mug / "photos/c.HEIC").touch()
    with refused(mug / "photos/c.HEIC"):
        capture_folder.read_capture(mug)


def test_a_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "cv2", None)
    with refused("cv2"):
        tools.opencv()


def test_colmap_leaves_sigterm_to_the_process():
    """Its own handler can wait for ever. A terminated stage must end at once, with the status of a terminated one."""
    pytest.importorskip("pycolmap")
    code = "import os; from neuma_lib.capture.tools import colmap; colmap(); os.kill(os.getpid(), 15)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == -signal.SIGTERM and "SIGTERM" not in done.stderr
