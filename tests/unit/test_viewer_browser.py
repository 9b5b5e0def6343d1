"""The viewer in a real browser: it loads, plays, and the slider moves pixels."""

import io

import numpy as np
import pytest
from browser import opened
from PIL import Image
from viewer_project import STEPS, make_project

from neuma_lib.viewer.find import found_scene
from neuma_lib.viewer.page import write_page
from neuma_lib.viewer.scene import load_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return make_project(tmp_path_factory.mktemp("viewer"))


def picture(page, selector="canvas"):
    """What is on the screen, RGB."""
    page.wait_for_timeout(150)
    shot = page.locator(selector).first.screenshot()
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


def differ(a, b):
    """Share of pixels that are not the same."""
    return float((np.abs(a - b).max(axis=-1) > 8).mean())


def test_the_file_opens_without_a_server_plays_and_follows_its_controls(folder, tmp_path):
    write_page(tmp_path / "viewer.html", load_scene(found_scene(folder)[1]))
    with opened((tmp_path / "viewer.html").as_uri()) as (page, complaints):
        page.wait_for_selector("body[data-state=ready]")
        page.select_option("#right", "")  # one motion: the truth, beside nothing
        first = picture(page)
        assert differ(first, np.full_like(first, 255)) > 0.02, "something is drawn"

        def at(frame):
            page.evaluate(
                "t => { const s = document.getElementById('time'); s.value = t; s.dispatchEvent(new Event('input')); }",
                frame,
            )
            return picture(page)

        last = at(len(STEPS) - 1)
        assert differ(first, last) > 0.01, "the slider moves pixels"
        assert differ(first, at(0)) == 0, "and back"
        assert page.inner_text("#clock") == "0 ms"

        page.select_option("#pace", "0.03125")
        page.click("#play")
        page.wait_for_selector("body[data-frame='2']", timeout=10_000)
        page.click("#play")
        assert differ(first, picture(page)) > 0.005, "it plays"

        seen = at(0)
        shown = {name: None for name in ("speed", "von_mises", "plastic_strain", "volume_ratio")}
        for name in shown:
            page.select_option("#show", name)
            shown[name] = at(2)
            assert page.is_visible("#legend") and differ(seen, shown[name]) > 0.01
        assert page.inner_text("#quantity") == "elastic volume ratio det F"
        page.select_option("#right", "1")
        assert differ(picture(page), shown["volume_ratio"]) > 0.01, "side by side"
        page.select_option("#show", "distance")
        assert "distance from NCLaw" in page.inner_text("#quantity") and "mm" in page.inner_text("#ends")
        page.select_option("#right", "")
        page.select_option("#show", "seen")

        page.select_option("#camera", "0")
        filmed = at(0)
        assert differ(seen, filmed) > 0.02, "through the camera"
        page.mouse.move(300, 250)
        page.mouse.down()
        page.mouse.move(380, 270, steps=4)
        page.mouse.up()
        assert page.input_value("#camera") == "" and differ(filmed, picture(page)) > 0.02, "a drag turns"
        assert not complaints
