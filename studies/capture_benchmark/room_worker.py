"""The Blender process of `room`: ``python -m studies.capture_benchmark.room_worker job.npz``.

Prints the number of finished shots on standard output, one line per shot, and writes each to ``<number>.npy``.
"""

import sys
from pathlib import Path

import numpy as np

from neuma_lib.data.blender.worker import claim_cores, quiet_stdout


def main(path: str) -> None:
    report = quiet_stdout()
    with np.load(path) as file:
        job = dict(file)
    claimed = claim_cores(int(job["threads"]))
    from studies.capture_benchmark import cycles_room

    folder = Path(path).parent
    cycles_room.start(job)
    for number, corners in enumerate(job["corners"]):
        cycles_room.add_rectangle(f"rectangle{number}", corners, job[f"picture{number}"])
    cameras = cycles_room.Cameras(job["lenses"])
    body = cycles_room.MovingBody(job)
    current = None
    for number, (lens, frame) in enumerate(job["shots"]):
        if (lens, frame) != current:
            read_out = float(job["row_time"]) * float(job["lenses"][lens][3])  # of the larger picture
            body.pose(int(frame), float(job["exposure"]), read_out)
            current = lens, frame
        cameras.become(int(lens), job["c2w"][number], job["regions"][number])
        pixels = cycles_room.shoot(str(folder / "shot.exr"), int(job["samples"]))
        np.save(folder / f"{number:05d}.npy", pixels.astype(np.float16))
        print(number + 1, file=report, flush=True)
    for lock in claimed:
        lock.close()


if __name__ == "__main__":
    main(sys.argv[1])
