"""What Python does before a script of a job: disable garbage collection during imports, limit libraries to one thread,
and choose a GPU.

Imports create many objects and no garbage. `workflow.stage.run_script` enables collection again.

Snakemake lets libraries of linear algebra use the threads of a job. Their sums would depend on that number, and they
wait actively for work, on the cores that the threads of `neuma_lib.threads` need.

With NEUMA_GPUS=2, each script sees one of two GPUs, shared out evenly. This must precede torch, Warp and Blender, which
look for devices. Each GPU has as many places as are asked for, and a script takes the lowest that is free on any. They
are locked files, which the system frees when a process ends, however it ends.
"""

import fcntl
import gc
import os
import platform
import sys
from itertools import count
from pathlib import Path

THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


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


# sys.argv is not there yet.
if any(f"{os.sep}.snakemake{os.sep}scripts{os.sep}" in word for word in sys.orig_argv[:4]):
    gc.disable()
    os.environ.update(dict.fromkeys(THREAD_LIMITS, "1"))
    if os.environ.get("NEUMA_GPUS", "").isdigit() and "CUDA_VISIBLE_DEVICES" not in os.environ:
        _gpu, _claim = claim_gpu(max(1, int(os.environ["NEUMA_GPUS"])))
        os.environ["CUDA_VISIBLE_DEVICES"] = str(_gpu)
