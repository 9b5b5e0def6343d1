"""The default settings, for all that read them."""

from pathlib import Path

import pytest

from neuma_lib.config import loading

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def raw():
    return loading.read_yaml(ROOT / "config" / "config.yaml")


@pytest.fixture(scope="module")
def loaded(raw):
    return loading.load(raw, ROOT)
