"""A stage reports what it does on any terminal, alone or next to others, and why it failed."""

import fcntl
import io
import itertools
import logging
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
        run.log("loss 0.5 -> 0.25")
    assert "\rmaterial Ball  " in text and re.search(r"5/10, loss 0.25, 00:0\d left", text)
    assert "█" * 12 + " " * 12 in text
    assert "\rmaterial Ball: loss 0.5 -> 0.25\r\n" in written()
    assert "loss 0.5 -> 0.25" in (tmp_path / "material.log").read_text()


def test_work_may_turn_out_to_be_more(terminal):
    stream, written = terminal
    with progress.stage("prior water", None, stream) as run:
        run.progress(9, 10, 0.5)
        time.sleep(2 * progress.MOVING_INTERVAL)
        run.progress(11, 20, 0.5)
        assert "11/20" in written()


def test_of_two_stages_on_one_terminal_the_second_prints_lines(terminal, monkeypatch):
    monkeypatch.setattr(progress, "PLAIN_INTERVAL", 0.0)
    stream, written = terminal
    with open(os.ttyname(stream.fileno())) as first:
        fcntl.flock(first, fcntl.LOCK_EX)
        with progress.stage("second", None, stream) as second:
            second.progress(1, 4, 2.0)
            second.progress(2, 4, 1.0)
        text = written()
        assert re.search(r"^second: 2/4, loss 1, 00:00 left\r\n", text, re.MULTILINE) and "█" not in text
    with progress.stage("third", None, stream) as third:
        third.progress(1, 4)
        time.sleep(2 * progress.MOVING_INTERVAL)
        third.progress(2, 4)
        assert "\rthird  █" in written(), "the terminal is free again"


def test_plain_lines_now_and_then_where_there_is_no_terminal(monkeypatch, tmp_path):
    def lines():
        stream = io.StringIO()
        with progress.stage("gaussians Ball", tmp_path / "log", stream) as run:
            for i in range(5):
                run.progress(i + 1, 5, 1.0)
        assert not {"\r", "\x1b"} & set(stream.getvalue())
        return stream.getvalue().splitlines()

    assert lines() == [], "short stages need none"
    monkeypatch.setattr(progress, "PLAIN_INTERVAL", 0.0)
    assert len(lines()) >= 4 and lines()[-1].startswith("gaussians Ball: 5/5, loss 1, ")
    assert "5/5, loss 1" in (tmp_path / "log").read_text()


def test_lines_go_on_when_the_clock_jumps_back(monkeypatch):
    monkeypatch.setattr(progress, "PLAIN_INTERVAL", 0.0)
    hours = itertools.count(0, -3600)
    monkeypatch.setattr("tqdm.std.time", lambda: float(next(hours)))
    stream = io.StringIO()
    with progress.stage("gaussians Ball", None, stream) as run:
        for i in range(5):
            run.progress(i + 1, 5)
    assert re.search(r"4/5, 00:00 left", stream.getvalue())


@pytest.mark.parametrize(
    ("error", "shown"),
    [
        (InputError("a.png is truncated: replace it"), "ERROR: a.png is truncated: replace it"),
        (NonFiniteError("material", "iteration 3"), "ERROR: material: iteration 3"),
        (
            OSError(28, "No space left on device", "a.png"),
            "ERROR: a.png: cannot be written: No space left on device. Free disk space and run the same command again.",
        ),
        (KeyError("x"), "ERROR: KeyError: 'x'"),
        (KeyboardInterrupt(), "ERROR: interrupted; run the same command again to go on"),
    ],
)
def test_errors_are_reported_in_one_line_and_logged_in_full(tmp_path, error, shown):
    log, stream = tmp_path / "deep" / "stage.log", io.StringIO()
    with pytest.raises(SystemExit) as end, progress.stage("mesh Ball", log, stream):
        raise error
    assert end.value.code == 1
    assert stream.getvalue() == f"mesh Ball: {shown} (more in {log})\n"
    assert "Traceback" in log.read_text() and type(error).__name__ in log.read_text()


def test_a_log_on_a_full_disk_adds_no_error(capsys):
    """/dev/full refuses every byte, as a full disk does."""
    stream = io.StringIO()
    with pytest.raises(SystemExit), progress.stage("mesh Ball", "/dev/full", stream):
        raise OSError(28, "No space left on device")
    assert stream.getvalue().startswith("mesh Ball: ERROR: output: cannot be written: No space left")
    assert capsys.readouterr().err == ""


def test_warnings_go_to_the_log(tmp_path):
    stream = io.StringIO()
    with progress.stage("mesh Ball", tmp_path / "log", stream):
        warnings.warn("slow path", stacklevel=1)
    assert "UserWarning: slow path" in (tmp_path / "log").read_text()
    assert stream.getvalue() == ""


@pytest.mark.parametrize("one_line", [True, False])
def test_results_of_a_stage_are_in_its_log(tmp_path, monkeypatch, one_line):
    """With one line a job, the terminal shows only its progress, warnings and errors."""
    monkeypatch.setattr(progress, "PLAIN_INTERVAL", 0.0)
    monkeypatch.setenv(progress.ONE_LINE, "1" if one_line else "")
    terminal, log = io.StringIO(), tmp_path / "fit.log"
    with pytest.raises(SystemExit), progress.stage("fit Ball", log, terminal) as run:
        run.log("loss 0.5")
        run.progress(1, 2)
        logging.getLogger("neuma_lib.sim").warning("slow")
        raise InputError("a.yaml", "is empty", "Write settings into it")
    shown = terminal.getvalue()
    assert ("loss 0.5" in shown) != one_line and "loss 0.5" in log.read_text()
    assert "fit Ball: 1/2" in shown and "fit Ball: slow" in shown and "ERROR: a.yaml: is empty" in shown


def test_a_script_ends_with_its_snakemake(tmp_path):
    """A Snakemake that is killed outright takes along what runs below it, through processes between; nothing else."""
    sleep = "import time; time.sleep(60)"
    script = (
        "from workflow.manager import end_with_snakemake; end_with_snakemake();"
        f"print('ready', flush=True); {sleep}"
    )
    snakemake = tmp_path / "snakemake"
    between = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {script!r}])"
    snakemake.write_text(f"import subprocess, sys; subprocess.run([sys.executable, '-c', {between!r}])")
    options = dict(cwd=ROOT, stdout=subprocess.PIPE, text=True)
    boss = subprocess.Popen([sys.executable, str(snakemake)], **options)
    free = subprocess.Popen([sys.executable, "-c", script], **options)
    assert boss.stdout.readline() == "ready\n" and free.stdout.readline() == "ready\n"
    boss.kill()
    boss.wait()
    # The pipe closes when the last process that holds it has ended.
    assert boss.stdout.read() == ""
    assert free.poll() is None
    free.kill()
    free.wait()
