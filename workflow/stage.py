"""What a stage tells: its log file, a line of progress on the terminal, and errors in plain words.

`stage` wraps the work of a script. Inside it, `print` and warnings reach the terminal, everything also goes to the
log, and an exception ends the process with one message on the terminal, its traceback in the log.

Several stages may run at once on one terminal. Only one of them draws a line that moves (it holds a lock on the
terminal); the others, and all of them when the output is no terminal, print a plain line now and then.
"""

from __future__ import annotations

import fcntl
import logging
import os
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from neuma_lib.errors import InputError, NonFiniteError
from workflow.owner import stop_with_owner

PLAIN_INTERVAL = 15.0  # seconds between plain lines
MOVING_INTERVAL = 0.2  # seconds between redraws of the moving line


@contextmanager
def stage(name: str, log: str | Path | None = None, stream: TextIO | None = None) -> Iterator[Stage]:
    """Run a stage: ``with stage("material BouncyBall/neuma", snakemake.log[0]) as run: ...``.

    Args:
        name: what is done, for messages.
        log: file that receives messages, warnings and tracebacks; None logs to the terminal only.
        stream: terminal, standard error by default.

    Raises:
        SystemExit: in place of any exception of the block, after it was reported.
    """
    stop_with_owner()
    run = Stage(name, log, stream or sys.stderr)
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, kind, *_: run.detail(f"{kind.__name__}: {message}")
            yield run
    except (Exception, KeyboardInterrupt) as error:
        run.fail(error)
        raise SystemExit(1) from None
    finally:
        run.close()


class Stage:
    """A running stage; made by `stage`."""

    def __init__(self, name: str, log: str | Path | None, stream: TextIO):
        self.name, self._stream = name, stream
        self._log_path = Path(log) if log else None
        self._log = None
        if self._log_path:
            self._log_path.parent.mkdir(parents=True, exist_ok=True)
            self._log = self._log_path.open("w", buffering=1)
        self._started = time.monotonic()
        self._lock = _terminal_lock(stream)
        self._shown = 0.0
        self._handler = _ToLog(self)
        logging.getLogger("neuma_lib").addHandler(self._handler)
        logging.getLogger("neuma_lib").setLevel(logging.INFO)

    def detail(self, text: str) -> None:
        """A line for the log file only."""
        if self._log:
            self._log.write(f"[{time.monotonic() - self._started:8.1f} s] {text}\n")

    def say(self, text: str) -> None:
        """A line for the terminal and the log: what was made, and how good it is."""
        self.detail(text)
        self._line(text)

    def progress(self, done: int, total: int, loss: float | None = None) -> None:
        """Show how far the work is, with the loss and the time left."""
        now = time.monotonic()
        moving = self._lock is not None
        if now - self._shown < (MOVING_INTERVAL if moving else PLAIN_INTERVAL) and done < total:
            return
        if not moving and self._shown == 0.0 and now - self._started < PLAIN_INTERVAL:
            return  # short stages need no plain lines
        if not hasattr(self, "_first"):
            self._first = (now, done)
        self._shown = now
        text = self._progress_text(done, total, loss, now)
        if moving:
            self._stream.write(f"\r\x1b[K{self.name}  {text}")
            self._stream.flush()
            self._moving_line = True
        else:
            self._line(text)
        if not moving or done >= total:
            self.detail(text)

    def _progress_text(self, done: int, total: int, loss: float | None, now: float) -> str:
        parts = [f"{done}/{total}"]
        if loss is not None:
            parts.append(f"loss {loss:.4g}")
        since, before = self._first
        if done > before:
            left = (now - since) / (done - before) * (total - done)
            parts.append(f"{_duration(left)} left" if done < total else f"{_duration(now - self._started)}")
        if self._lock is not None:
            filled = round(24 * done / max(total, 1))
            parts.insert(0, "█" * filled + "·" * (24 - filled))
        return "  ".join(parts)

    def fail(self, error: BaseException) -> None:
        """Report an exception: its message on the terminal, its traceback in the log."""
        self.detail("".join(traceback.format_exception(error)).rstrip())
        if isinstance(error, InputError | NonFiniteError):
            text = str(error)
        elif isinstance(error, KeyboardInterrupt):
            text = "interrupted; run the same command again to go on"
        else:
            text = f"{type(error).__name__}: {error}"
        where = f" (more in {self._log_path})" if self._log_path else ""
        self._line(f"ERROR: {text}{where}")

    def close(self) -> None:
        """Give terminal and log back."""
        if getattr(self, "_moving_line", False):
            self._stream.write("\r\x1b[K")
        logging.getLogger("neuma_lib").removeHandler(self._handler)
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
        if self._log:
            self._log.close()
            self._log = None

    def _line(self, text: str) -> None:
        clear = "\r\x1b[K" if self._stream.isatty() else ""
        self._stream.write(f"{clear}{self.name}: {text}\n")
        self._stream.flush()
        self._moving_line = False


class _ToLog(logging.Handler):
    """Sends the library's log records to the stage's log, warnings to the terminal as well."""

    def __init__(self, run: Stage):
        super().__init__()
        self._run = run

    def emit(self, record: logging.LogRecord) -> None:
        (self._run.say if record.levelno >= logging.WARNING else self._run.detail)(record.getMessage())


def _terminal_lock(stream: TextIO) -> int | None:
    """An open, locked descriptor of the terminal behind ``stream``; None if it is none or another stage has it."""
    try:
        descriptor = os.open(os.ttyname(stream.fileno()), os.O_RDWR | os.O_NOCTTY)
    except (OSError, ValueError, AttributeError):
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
