"""A process that has imported the libraries and is forked for each script of a job.

Imports, torch's above all, take 2 core seconds, more than the work of most jobs. A run of Snakemake on one machine
therefore starts one process that imports the libraries of others, and no module of this project. A script hands it its
arguments, folder, environment and standard streams (`workflow/interpreter/sitecustomize.py`). The process forks, its
copy runs the script, and the first process waits for the status of that copy. So each job still has its own process,
and all start from the same state.

A script runs as usual where there is no such process: on a cluster, and with a GPU. Libraries read their number of
threads when they are loaded, hence those of a copy have one, whatever the job has: `neuma_lib.threads` uses the others.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import runpy
import selectors
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Mapping
from contextlib import suppress
from importlib import import_module
from pathlib import Path

VARIABLE = "NEUMA_PRELOADED"
LIBRARIES = (
    "torch",
    "warp",
    "scipy.optimize",
    "scipy.spatial",
    "skimage.measure",
    "trimesh",
    "h5py",
    "plyfile",
    "pydantic",
    "yaml",
    "PIL.Image",
    "psutil",
    "tqdm",
    "snakemake.script",
)


def start(libraries: tuple[str, ...] = LIBRARIES) -> subprocess.Popen:
    """Start the process for all scripts that this process runs from now on. It ends with this process."""
    path = Path(tempfile.mkdtemp(prefix="neuma-")) / "socket"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen(64)
        os.environ[VARIABLE] = f"{path}:{sys.executable}"
        number = listener.fileno()
        command = [sys.executable, __file__, str(number), *libraries]
        return subprocess.Popen(command, stdin=subprocess.PIPE, pass_fds=[number])


def serve(listener: socket.socket) -> list[str]:
    """Fork for each script. Returns the script with its arguments in each copy, and an empty list at the end of all."""
    wake, woken = os.pipe()
    os.set_blocking(woken, False)
    signal.set_wakeup_fd(woken)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    running: dict[int, socket.socket] = {}  # processes of scripts, and the connections to their first ones
    selector = selectors.DefaultSelector()
    for file in (listener, wake, sys.stdin):
        selector.register(file, selectors.EVENT_READ)
    while True:
        for key, _ in selector.select():
            if key.fileobj is sys.stdin:  # Snakemake has ended
                for child in running:
                    os.kill(child, signal.SIGKILL)
                return []
            if key.fileobj is listener:
                connection, _ = listener.accept()
                try:
                    job, streams = _receive(connection)
                except (OSError, ValueError):  # its first process was killed
                    connection.close()
                    continue
                child = os.fork()
                if not child:
                    selector.close()
                    for file in (listener, connection, *running.values()):
                        file.close()
                    for number in (wake, woken):
                        os.close(number)
                    return _become(job, streams)
                running[child] = connection
                selector.register(connection, selectors.EVENT_READ, child)
                for stream in streams:
                    os.close(stream)
            elif key.fileobj is wake:
                os.read(wake, 4096)
                for child in list(running):
                    ended, status = os.waitpid(child, os.WNOHANG)
                    if ended:
                        connection = running.pop(child)
                        selector.unregister(connection)
                        code = os.waitstatus_to_exitcode(status)
                        with suppress(OSError):
                            connection.sendall(code.to_bytes(2, "big", signed=True))
                        connection.close()
            elif key.data in running:  # the script's first process was killed
                os.kill(key.data, signal.SIGKILL)


def _receive(connection: socket.socket) -> tuple[dict, list[int]]:
    header, streams, *_ = socket.recv_fds(connection, 8, 3)
    size, parts = int.from_bytes(header, "big"), []
    while size and (part := connection.recv(size)):
        parts.append(part)
        size -= len(part)
    connection.sendall(b"\1")
    if not connection.recv(1):
        raise ConnectionResetError
    return json.loads(b"".join(parts)), streams


def _become(job: Mapping, streams: list[int]) -> list[str]:
    """Give this process what the script's first process had; the script and its arguments."""
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with suppress(OSError):  # of the group that Ctrl-C ends
        os.setpgid(0, job["group"])
    os.environ.clear()
    os.environ.update(job["environment"])
    os.chdir(job["folder"])
    return job["words"]


def _run(words: list[str]) -> None:
    """Run a script, and end this process without giving back the memory of the libraries piece by piece."""
    sys.argv, sys.path[0] = words, str(Path(words[0]).parent)
    status = 0
    try:
        runpy.run_path(words[0], run_name="__main__")
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
        if not isinstance(end.code, int | None):
            print(end.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
        status = 1
    threading._shutdown()
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)


def main(number: int, libraries: list[str]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    words = []
    with socket.socket(fileno=number) as listener:
        folder = Path(listener.getsockname()).parent
        try:
            for library in libraries:
                import_module(library)
            gc.collect()
            gc.freeze()  # so that copies share the memory of what was imported
            words = serve(listener)
        finally:
            if not words:
                shutil.rmtree(folder, ignore_errors=True)
    if words:
        _run(words)


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2:])
