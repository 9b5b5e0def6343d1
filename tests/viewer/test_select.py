"""The page on which a user marks the object: what it writes is read as the settings of a capture."""

import pytest
import yaml
from PIL import Image

from neuma_lib.cli import main
from neuma_lib.config.capture import CaptureConfig
from neuma_lib.viewer.select import write_select_page
from tests.support.browser import opened
from tests.support.errors import refused


def capture(folder, names=("a b.jpg", "c.jpg")):
    (folder / "photos").mkdir(parents=True)
    (folder / "stills").mkdir()
    (folder / "videos").mkdir()
    (folder / "capture.yaml").write_text("prior: jelly\n")
    for name in names:
        Image.new("RGB", (400, 300), (90, 120, 60)).save(folder / "photos" / name)
    for file in ("stills/left.png",):
        Image.new("RGB", (64, 48)).save(folder / file)
    (folder / "videos/left.mp4").write_bytes(b"video")
    return folder


def test_a_capture_without_photographs_is_refused(tmp_path):
    folder = capture(tmp_path / "mug")
    for file in (folder / "photos").iterdir():
        file.unlink()
    with refused(folder):
        write_select_page(folder)


@pytest.mark.parametrize("command", ["select", "view"])
def test_the_viewer_has_the_page_for_the_folder_of_a_capture(command, tmp_path, capsys):
    folder = capture(tmp_path / "mug")
    assert main([command, str(folder)]) == 0
    assert capsys.readouterr().out == f"Open {folder / 'select.html'} in a browser\n"
    assert "a b.jpg" in (folder / "select.html").read_text()


def test_a_click_and_a_rectangle_become_lines_of_the_settings(tmp_path):
    page_file = write_select_page(capture(tmp_path / "mug </script>"))
    with opened(page_file.as_uri(), 900, 700) as (page, complaints):
        page.locator("#photo").evaluate("image => image.decode()")
        area = page.locator("#photo").bounding_box()

        def at(x, y):
            return area["x"] + x * area["width"] / 400, area["y"] + y * area["height"] / 300

        def settings():
            return CaptureConfig(**yaml.safe_load(page.inner_text("#line").replace("???", "0.3")))

        page.mouse.click(*at(120, 80))
        assert settings().object["a b.jpg"] == pytest.approx((120, 80), abs=1)
        page.mouse.move(*at(300, 200))
        page.mouse.down()
        page.mouse.move(*at(200, 100))
        page.mouse.up()
        assert settings().object["a b.jpg"] == pytest.approx((200, 100, 300, 200), abs=1)
        page.select_option("#kind", "length")
        for name, ends in (("a b.jpg", [(10, 20), (390, 280)]), ("c.jpg", [(50, 60), (70, 80)])):
            page.select_option("#file", name)
            page.locator("#photo").evaluate("image => image.decode()")
            for end in ends:
                page.mouse.click(*at(*end))
        ends = settings().length.ends
        assert sorted(ends) == ["a b.jpg", "c.jpg"] and ends["c.jpg"][1] == pytest.approx((70, 80), abs=1)
        assert not complaints
