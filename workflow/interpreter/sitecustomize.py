"""What Python does before it runs a script of a job: take a GPU, and let a preloaded process run the script.

Several GPUs for the jobs of one Snakemake: with NEUMA_GPUS=2 each script sees one of two, shared out evenly. Each GPU
has as many places as are asked for, and a script takes the lowest that is free on any; they are locked files, which the
system frees when a process ends, however it ends.

`workflow.preloaded` describes the other part.
"""

import fcntl
import json
import os
import platform
import signal
import socket
import sys
from itertools import count
from pathlib import Path


def claim_gpu(gpus: int) -> tuple[int, object]:
    """The GPU with the lowest free place, and the open file that holds it: keep it for as long as it counts."""
    # in the common temporary folder a name could be a link that another user made
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "neuma_lib" / platform.node()
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for place in count():
        for gpu in range(gpus):
            flags = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW
            file = open(os.open(folder / f"gpu-{gpu}-{place}.lock", flags, 0o600), "w")
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return gpu, file
            except OSError:
                file.close()


def run_preloaded(server: str, words: list[str]) -> None:
    """Let the preloaded process run a script, and end with its status. Returns if there is no such process.

    Args:
        server: path of its socket.
        words: the script and its arguments.
    """
    job = {"words": words, "folder": os.getcwd(), "environment": dict(os.environ), "group": os.getpgrp()}
    text = json.dumps(job).encode()
    connection = socket.socket(socket.AF_UNIX)
    try:
        connection.connect(server)
        socket.send_fds(connection, [len(text).to_bytes(8, "big")], [0, 1, 2])
        connection.sendall(text)
        if not connection.recv(1):  # it could not import its libraries
            return
        # From here on Ctrl-C is for the copy, which may write a message before it ends.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        connection.sendall(b"\1")
    except OSError:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        return
    status = int.from_bytes(connection.recv(2) or b"\0\1", "big", signed=True)
    if status < 0:
        signal.signal(-status, signal.SIG_DFL)
        os.kill(os.getpid(), -status)
    os._exit(status)


# sys.argv is not there yet.
_script = next(
    (k for k, word in enumerate(sys.orig_argv[:4]) if f"{os.sep}.snakemake{os.sep}scripts{os.sep}" in word), 0
)
if _script and os.environ.get("NEUMA_GPUS", "").isdigit() and "CUDA_VISIBLE_DEVICES" not in os.environ:
    _gpu, _claim = claim_gpu(max(1, int(os.environ["NEUMA_GPUS"])))
    os.environ["CUDA_VISIBLE_DEVICES"] = str(_gpu)
_server, _, _python = os.environ.get("NEUMA_PRELOADED", "").partition(":")
if _script and _python == sys.executable:
    run_preloaded(_server, sys.orig_argv[_script:])
