"""A stage tells what it does on any terminal, alone or beside others, and why it failed."""

import io
import os
import pty
import re
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest

from neuma_lib.errors import InputError, NonFiniteError
from workflow import owner
from workflow import stage as progress

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def terminal():
    """A pseudo-terminal: (its stream, a function that returns what was written)."""
    reader, writer = pty.openpty()
    stream = os.fdopen(writer, "w")

    def written():
        stream.flush()
        os.set_blocking(reader, False)
        text = b""
        while True:
            try:
                text += os.read(reader, 65536)
            except (BlockingIOError, OSError):
                return text.decode()

    yield stream, written
    stream.close()
    os.close(reader)


def test_a_bar_with_loss_and_time_left(terminal, tmp_path):
    stream, written = terminal
    with progress.stage("material Ball", tmp_path / "material.log", stream) as run:
        run.progress(1, 10, 0.5)
        time.sleep(2 * progress.MOVING_INTERVAL)
        run.progress(5, 10, 0.25)
        text = written()
        run.say("loss 0.5 -> 0.25")
    assert "\r\x1b[Kmaterial Ball  " in text and re.search(r"5/10  loss 0.25  0:0\d left", text)
    assert "█" * 12 + "·" * 12 in text
    assert "loss 0.5 -> 0.25" in (tmp_path / "material.log").read_text()


def test_two_stages_on_one_terminal_share_it(terminal, monkeypatch):
    """One draws a line that moves; the other prints whole lines, each on a line of its own."""
    monkeypatch.setattr(progress, "PLAIN_INTERVAL", 0.0)
    stream, written = terminal
    with progress.stage("first", None, stream) as first:
        with progress.stage("second", None, stream) as second:
            first.progress(1, 4)
            second.progress(1, 4, 2.0)
            second.progress(2, 4, 1.0)
        text = written()
        assert text.count("█") > 0
        assert "\r\x1b[Ksecond: 1/4  loss 2\r\n" in text and "second: 2/4  loss 1" in text
        assert "second  " not in text
    with progress.stage("third", None, stream) as third:
        third.progress(1, 4)
        assert "\r\x1b[Kthird  " in written(), "the terminal is free again"


def test_plain_lines_now_and_then_where_there_is_no_terminal(monkeypatch):
    stream = io.StringIO()
    with progress.stage("gaussians Ball", None, stream) as run:
        for i in range(1000):
            run.progress(i + 1, 1000, 1.0)
    assert (
        stream.getvalue().count("\n") <= 2
        and "\r" not in stream.getvalue()
        and "\x1b" not in stream.getvalue()
    )
    monkeypatch.setattr(progress, "PLAIN_INTERVAL", 0.0)
    stream = io.StringIO()
    with progress.stage("gaussians Ball", None, stream) as run:
        for i in range(5):
            run.progress(i + 1, 5, 1.0)
    assert stream.getvalue().count("\n") == 5


@pytest.mark.parametrize(
    ("error", "shown"),
    [
        (InputError("a.png is truncated: replace it"), "ERROR: a.png is truncated: replace it"),
        (NonFiniteError("material", "iteration 3"), "ERROR: material: iteration 3"),
        (KeyError("x"), "ERROR: KeyError: 'x'"),
        (KeyboardInterrupt(), "ERROR: interrupted; run the same command again to go on"),
    ],
)
def test_errors_are_told_in_one_line_and_logged_in_full(tmp_path, error, shown):
    log, stream = tmp_path / "deep" / "stage.log", io.StringIO()
    with pytest.raises(SystemExit) as end, progress.stage("mesh Ball", log, stream):
        raise error
    assert end.value.code == 1
    assert stream.getvalue() == f"mesh Ball: {shown} (more in {log})\n"
    assert "Traceback" in log.read_text() and type(error).__name__ in log.read_text()


def test_warnings_go_to_the_log(tmp_path):
    stream = io.StringIO()
    with progress.stage("mesh Ball", tmp_path / "log", stream):
        warnings.warn("slow path", stacklevel=1)
    assert "UserWarning: slow path" in (tmp_path / "log").read_text()
    assert stream.getvalue() == ""


def test_work_ends_with_its_owner():
    """A process that is killed outright takes along the stages that it owns, and no others."""
    sleep = "import time; time.sleep(60)"
    work = (
        f"from workflow.owner import stop_with_owner; stop_with_owner(); print('ready', flush=True); {sleep}"
    )
    start = (
        "import subprocess, sys; from workflow.owner import claim; claim();"
        f"subprocess.Popen([sys.executable, '-c', {work!r}]); {sleep}"
    )
    environment = {k: v for k, v in os.environ.items() if k != owner.VARIABLE}
    options = dict(cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True)
    boss = subprocess.Popen([sys.executable, "-c", start], **options)
    free = subprocess.Popen([sys.executable, "-c", work], **options)
    assert boss.stdout.readline() == "ready\n" and free.stdout.readline() == "ready\n"
    boss.kill()
    boss.wait()
    # The pipe closes when the last process that holds it, the stage, has ended.
    assert boss.stdout.read() == ""
    assert free.poll() is None
    free.kill()
    free.wait()
