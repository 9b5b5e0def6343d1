"""YAML of users: bounded before anything is built of it, with file, line and column in every message."""

import resource
import subprocess
import sys
import time
from pathlib import Path

import pytest

from neuma_lib.io.yaml_files import MAX_BYTES, load_yaml, parse_yaml
from tests.support.errors import refused

pytestmark = pytest.mark.core

ROOT = Path(__file__).resolve().parents[2]
ALIASES = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12)
)
"""4 kB that expand to 9^12 values."""


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (ALIASES, "line 6"),
        (ALIASES.replace("[*", "{<<: [*").replace("]\n", "]}\n"), "line"),
        ("a: &a [*a]", "line 1, column 8: *a"),
        ("a: *b", "*b names nothing"),
        ("[" * 200_000, "nested"),
        ("- " * 100_000, "nested"),
        ("{a: " * 50_000, "nested"),
        ("- &a\n" * 50_000, "line 2, column 3"),
        ("x: " + "1:" * 5_000 + "1", "more than 3000 characters"),
        ("x: " + "9" * 5_000, "more than 3000 characters"),
        ("a: 1\nb:\n  c: 1\n  c: 2\n", "line 4, column 3: the key 'c' is in line 3 already"),
        ("a: [1,\n", "line 2, column 1: invalid YAML"),
        ("a: 1\n\tb: 2", "line 2, column 1: invalid YAML"),
        ("a: 1\n---\nb: 2", "line 2"),
        ("a: !!python/object/apply:os.getcwd []", "line 1, column 4"),
        ("? [1]\n: 2", "line 1, column 3"),
        ("a: 2001-99-99", "month"),
        ("k\0", "control characters"),
        (b"\xff\xfe\x00", "UTF-16"),
    ],
)
def test_broken_and_hostile_texts_end_in_one_line(text, problem):
    start = time.monotonic()
    with refused("mine.yaml", problem=problem):
        parse_yaml(text, "mine.yaml")
    assert time.monotonic() - start < 5


def test_aliases_and_equal_keys_of_different_mappings_are_allowed():
    text = "a: &a {x: 1, y: [1, 2]}\nb: {<<: *a, x: 2}\nc: [*a, *a]\nd: {a: 1}\n"
    a = {"x": 1, "y": [1, 2]}
    assert parse_yaml(text, "mine.yaml") == {"a": a, "b": {**a, "x": 2}, "c": [a, a], "d": {"a": 1}}
    assert parse_yaml("# nothing\n", "mine.yaml") is None


def test_files_are_bounded_before_they_are_read(tmp_path):
    large = tmp_path / "large.yaml"
    with open(large, "wb") as file:
        file.truncate(10**12)
    with refused(large, problem=f"larger than {MAX_BYTES} bytes"):
        load_yaml(large)
    with refused("/dev/zero", problem="is not a regular file"):
        load_yaml("/dev/zero")


def test_expansion_needs_no_memory(tmp_path):
    (tmp_path / "mine.yaml").write_text(ALIASES)
    code = "import sys; from neuma_lib.io.yaml_files import load_yaml; load_yaml(sys.argv[1])"
    command = [sys.executable, "-c", code, str(tmp_path / "mine.yaml")]
    done = subprocess.run(
        command,
        cwd=ROOT,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (500 * 2**20,) * 2),
    )
    assert done.returncode == 1 and "InputError" in done.stderr and "MemoryError" not in done.stderr
