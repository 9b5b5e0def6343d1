"""Log, progress on the terminal and error messages of a script.

`stage` wraps the work of a script. Its messages and warnings of the library go to the terminal and the log, warnings
of Python to the log alone. An exception ends the process with one line on the terminal and a traceback in the log.

Several stages may share a terminal. The one that holds a lock on it draws a moving bar. The others, and all stages
without a terminal, print a plain line every 15 seconds.
"""

import fcntl
import gc
import logging
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, TextIO

from tqdm import tqdm

from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.extensions import load_laws
from neuma_lib.io.files import unwritable
from neuma_lib.project import versions
from workflow.manager import end_with_snakemake

ONE_LINE = "NEUMA_ONE_LINE_A_JOB"  # set by `workflow.progress` for the processes of jobs
PLAIN_INTERVAL = 15.0  # seconds between plain lines
MOVING_INTERVAL = 0.2  # seconds between redraws of the moving bar
STATE = "{n_fmt}/{total_fmt}{postfix}, {remaining} left"
WIDTH, ROWS = 80, 24  # of a terminal of unknown size
LOG_FORMAT = "[%(asctime)s] %(message)s"

_LOGGER = logging.getLogger("neuma_lib.stage")
_LOG_LOGGER = logging.getLogger("neuma_lib.log")  # for the log alone
# read by neuma_lib.project.timings
_USED = "core seconds: {:.2f} to start, {:.2f} of work; memory: {:.1f} MB"


@contextmanager
def stage(name: str, log: str | Path | None = None, stream: TextIO | None = None) -> "Iterator[Stage]":
    """Run a stage: ``with stage("material BouncyBall/neuma", snakemake.log[0]) as run: ...``. One a process.

    Args:
        name: what is done, for messages.
        log: file that receives messages, warnings and tracebacks; None logs to the terminal only.
        stream: terminal, standard error by default.

    Raises:
        SystemExit: in place of any exception of the block, after it was reported.
    """
    end_with_snakemake()
    run, root = Stage(name, stream or sys.stderr), logging.getLogger()
    handlers: list[logging.Handler] = [_Terminal(run)]
    if log:
        Path(log).parent.mkdir(parents=True, exist_ok=True)
        handlers.append(_Log(log, "w"))
        handlers[-1].setFormatter(logging.Formatter(LOG_FORMAT))
    for handler in handlers:
        root.addHandler(handler)
    logging.getLogger("neuma_lib").setLevel(logging.INFO)
    logging.captureWarnings(True)
    try:
        yield run
    except (Exception, KeyboardInterrupt) as error:
        _LOGGER.error("ERROR: %s%s", _plain(error), f" (more in {log})" if log else "", exc_info=error)
        raise SystemExit(1) from None
    finally:
        logging.captureWarnings(False)
        run.close()
        for handler in handlers:
            root.removeHandler(handler)
            handler.close()


class NoCompiler(ModuleType):
    """Stands for torch's compiler, because optimisers import it, in 0.8 core seconds, to exclude themselves from it.

    Whatever else is asked of it imports it after all.
    """

    @staticmethod
    def graph_break() -> None:
        pass

    @staticmethod
    def disable(function: Callable, recursive: bool = True, *, wrapping: bool = True) -> Callable:
        return function

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # the import system asks for these
            raise AttributeError(name)
        del sys.modules[self.__name__]
        return getattr(import_module(self.__name__), name)


def run_script(main: Callable, snakemake) -> None:
    """Run ``main(input, output, params, run)`` of a script as the stage of its rule and wildcards."""
    gc.freeze()  # otherwise each collection, and the end of the process, visits all objects of the libraries
    gc.enable()
    sys.modules.setdefault("torch._dynamo", NoCompiler("torch._dynamo"))
    name = " ".join(filter(None, [snakemake.rule, "/".join(filter(None, snakemake.wildcards))]))
    started = _core_seconds()  # of the interpreter and all imports
    with stage(name, snakemake.log[0]) as run:
        _LOG_LOGGER.info(versions.line())
        load_laws(snakemake.config.get("extensions") or ())
        main(snakemake.input, snakemake.output, snakemake.params, run)
        _LOG_LOGGER.info(_USED.format(started, _core_seconds() - started, _memory()))


def _core_seconds() -> float:
    """Seconds that all threads of this process and its finished children have kept a core busy."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in used)


def _memory() -> float:
    """Most memory that this process or one of its finished children had at once [MB]."""
    used = [resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return max(used) / (2**20 if sys.platform == "darwin" else 2**10)


class Stage:
    """A running stage; made by `stage`."""

    def __init__(self, name: str, stream: TextIO):
        self.name, self.stream = name, stream
        self._terminal = _locked_terminal(stream)
        self._bar: tqdm | None = None

    def log(self, text: str) -> None:
        """Write a line to the terminal and the log."""
        _LOGGER.info(text)

    def progress(self, done: int, total: int, loss: float | None = None) -> None:
        """Show how far the work is, with the loss and the time left."""
        if self._bar is None:
            moving = self._terminal is not None
            interval = MOVING_INTERVAL if moving else PLAIN_INTERVAL
            # Where the bar cannot move, what it draws becomes lines.
            lines = SimpleNamespace(write=_write_progress, flush=lambda: None)
            self._bar = tqdm(
                total=total,
                initial=done,
                desc=self.name,
                file=self.stream if moving else lines,
                mininterval=interval,
                delay=interval,  # short stages need no lines
                miniters=0,
                leave=False,
                ncols=os.get_terminal_size(self._terminal.fileno()).columns or WIDTH if moving else None,
                nrows=ROWS,
                bar_format=("{desc}  {bar:24}  " if moving else "") + STATE,
            )
            # tqdm takes the clock of the system, which may jump.
            self._bar._time = time.monotonic
            self._bar.start_t = self._bar.last_print_t = time.monotonic()
        if loss is not None:
            self._bar.set_postfix_str(f"loss {loss:.4g}", refresh=False)
        self._bar.total = total  # work may turn out to be more
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        """Release the terminal."""
        if self._bar is not None:
            self._bar.close()
        if self._terminal is not None:
            self._terminal.close()


class _Log(logging.FileHandler):
    """A file of messages; those that do not fit on a full disk are lost without an error."""

    def handleError(self, record: logging.LogRecord) -> None:
        pass

    def close(self) -> None:
        with suppress(OSError):
            super().close()


class _Terminal(logging.Handler):
    """Shows messages of the stage and warnings of the library above the moving bar."""

    def __init__(self, run: Stage):
        super().__init__()
        self._run = run

    def emit(self, record: logging.LogRecord) -> None:
        warned = record.name.startswith("neuma_lib") and record.levelno >= logging.WARNING
        # Where Snakemake shows one line a job, results are in the log alone.
        displayed = hasattr(record, "progress") or not os.environ.get(ONE_LINE)
        if warned or (record.name == _LOGGER.name and displayed):
            tqdm.write(f"{self._run.name}: {record.getMessage()}", file=self._run.stream)
            self._run.stream.flush()


def _write_progress(text: str) -> None:
    if text.strip():
        _LOGGER.info(text.strip(), extra={"progress": True})


def _locked_terminal(stream: TextIO) -> TextIO | None:
    """The terminal behind a stream, opened and locked; None if there is none or another stage has it."""
    try:
        terminal = open(os.ttyname(stream.fileno()))
        fcntl.flock(terminal, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (OSError, ValueError):
        return None
    return terminal


def _plain(error: BaseException) -> str:
    if isinstance(error, InputError | NonFiniteError):
        return str(error)
    if full := unwritable(error):
        return str(full)
    if isinstance(error, KeyboardInterrupt):
        return "interrupted; run the same command again to go on"
    return f"{type(error).__name__}: {error}"
