"""The Blender process: ``python -m neuma_lib.blender job.npz`` renders a job of `neuma_lib.blender.scene`.

Prints the number of finished images, a line each, on standard output; Blender's own chatter goes to standard error.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import numpy as np


def _quiet_stdout():
    """A stream to the real standard output; file descriptor 1 becomes standard error, because Blender prints in C."""
    sys.stdout.flush()
    real = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    return real


def main(path: str) -> None:
    report = _quiet_stdout()
    with np.load(path) as file:
        job = dict(file)
    settings = json.loads(str(job["settings"]))
    if hasattr(os, "sched_setaffinity"):
        # Cycles' own thread limit leaves its helpers on every core.
        cores = sorted(os.sched_getaffinity(0))
        first = os.getpid() % len(cores)
        os.sched_setaffinity(0, [cores[(first + k) % len(cores)] for k in range(min(settings["threads"], len(cores)))])
    from neuma_lib.blender import cycles

    folder = Path(path).parent
    cycles.start(settings, *(int(s) for s in job["size"]))
    body = cycles.Body(job)
    camera = cycles.add_camera(float(job["focal"]), int(job["size"][0]))
    shown = None
    for index, (frame, view) in enumerate(job["shots"]):
        if frame != shown:
            body.show(int(frame))
            shown = frame
        cycles.place(camera, job["c2w"][view])
        cycles.render(folder / f"{index:05d}.png")
        print(index + 1, file=report, flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
