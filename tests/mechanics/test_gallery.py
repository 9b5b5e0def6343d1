"""The gallery of laws on the site agrees with the laws. `python -m docs.laws` writes it again."""

import re
from pathlib import Path

import numpy as np
import pytest

laws = pytest.importorskip("docs.laws", exc_type=ImportError)  # draws with matplotlib

ROOT = Path(__file__).resolve().parents[2]
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
CLIP = re.compile(r"\bp[0-9a-f]{10}\b")
"""Name of a clipping path in matplotlib's files, a hash of its position."""


def test_the_page_lists_the_built_in_laws():
    assert (ROOT / laws.PAGE).read_text() == laws.page()


def test_pictures_show_the_curves_of_the_laws():
    """To 0.2 px, since the last digit depends on the processor. Versions of matplotlib draw in different ways."""
    pictures = laws.pictures()
    assert {file.name for file in (ROOT / laws.PICTURES).iterdir()} == set(pictures)
    for name, expected in pictures.items():
        text, expected = CLIP.sub("", (ROOT / laws.PICTURES / name).read_text()), CLIP.sub("", expected)
        if f"v{laws.matplotlib.__version__}," not in text:
            pytest.skip("another version of matplotlib wrote the pictures")
        assert NUMBER.sub("", text) == NUMBER.sub("", expected), name
        numbers = [np.array(NUMBER.findall(svg), float) for svg in (text, expected)]
        np.testing.assert_allclose(*numbers, atol=0.2, err_msg=name)
