"""The Blender process: ``python -m neuma_lib.data.blender.worker job.npz`` renders a job of `scene`.

Prints the number of finished images on standard output, one line per image. Output of Blender goes to standard error.
"""

import fcntl
import os
import platform
import sys
from pathlib import Path

import numpy as np


def quiet_stdout():
    """Stream to the original standard output. File descriptor 1 is redirected to standard error for prints in C."""
    sys.stdout.flush()
    real = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    return real


def own_lock(name: str) -> int:
    """File descriptor of a lock file of this user on this computer, in a folder that other users cannot enter.

    A name in the common temporary folder could be a link that another user made.
    """
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "neuma_lib" / platform.node()
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    return os.open(folder / f"{name}.lock", os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)


def claim_cores(count: int) -> list:
    """Pin this process to up to ``count`` cores that no other of our Blender processes uses.

    The thread limit of Cycles does not apply to its helper threads. Returns lock files to keep open while rendering.
    """
    if not hasattr(os, "sched_setaffinity"):
        return []
    cores, locks, mine = sorted(os.sched_getaffinity(0)), [], []
    for core in cores:
        if len(mine) == count:
            break
        try:
            lock = open(own_lock(f"blender-{core}"), "w")
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # another process has it, or there is no folder to write to
            continue
        locks.append(lock)
        mine.append(core)
    os.sched_setaffinity(0, mine or cores)
    return locks


def main(path: str) -> None:
    report = quiet_stdout()
    with np.load(path) as file:
        job = dict(file)
    threads = int(job["threads"])
    claimed = claim_cores(threads)
    from neuma_lib.data.blender import cycles

    folder = Path(path).parent
    cycles.start(*(int(s) for s in job["size"]), int(job["samples"]), threads, str(job["device"]))
    matte, count = bool(job["matte"]), int(job.get("bodies", 0))
    several = [{name.removeprefix(f"{k}_"): value for name, value in job.items()} for k in range(count)]
    bodies = [cycles.Body(own) for own in several or [job]]
    obstacles = cycles.Obstacles(job, shadows=not matte)
    camera = cycles.add_camera(float(job["focal"]), int(job["size"][0]))
    current = None
    for index, (frame, view) in enumerate(job["shots"]):
        if frame != current:
            for body in bodies:
                body.show(int(frame))
            obstacles.show(int(frame))
            current = frame
        cycles.place(camera, job["c2w"][view])
        if matte and obstacles.objects:
            obstacles.cut_out(False)
            cycles.render(folder / f"{index:05d}_all.png")
            obstacles.cut_out(True)
        cycles.render(folder / f"{index:05d}.png")
        for k in range(count if matte else 0):  # the mask of a body ends where another hides it
            cycles.cut_out_others(bodies, k)
            cycles.render(folder / f"{index:05d}_body{k}.png")
            cycles.cut_out_others(bodies, None)
        print(index + 1, file=report, flush=True)
    for lock in claimed:
        lock.close()


if __name__ == "__main__":
    main(sys.argv[1])
