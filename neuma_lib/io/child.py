"""Files of other programs, read in a child process: neither a damaged nor a hostile one can exhaust the memory.

For formats whose readers allocate before they check, or may crash. The child returns arrays and no objects.
"""

import os
import subprocess
import sys
from importlib import import_module
from io import BytesIO
from pathlib import Path

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.io.files import one_line

MAX_MEMORY = 384 * 2**20  # address space that a child may add to that of the loaded libraries [bytes]
MAX_SECONDS = 30
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def arrays_from_child(reader: str, path: str | Path, kind: str) -> dict[str, np.ndarray]:
    """Arrays by name that a function returns for a file, called in a child process.

    Args:
        reader: ``module:function`` of a path.
        kind: content of the file, for messages.

    Raises:
        InputError: the function fails, ends its process, or exceeds its memory or time.
    """
    environment = {**os.environ, **_ONE_THREAD, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-m", __name__, reader, str(path)]
    remedy = "Export it again from the program that wrote it, or with less detail"
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, env=environment, timeout=MAX_SECONDS
        )
    except subprocess.TimeoutExpired:
        problem = f"cannot be read as {kind} within {MAX_SECONDS} s"
        raise InputError(path, problem, remedy) from None
    if done.returncode:
        reason = one_line(done.stderr.decode(errors="replace").strip().rpartition("\n")[2])
        problem = f"cannot be read as {kind}: {reason or f'the reader ended with status {done.returncode}'}"
        raise InputError(path, problem, remedy)
    with np.load(BytesIO(done.stdout), allow_pickle=False) as arrays:
        return dict(arrays)


def _main(reader: str, path: str) -> None:
    module, _, function = reader.partition(":")
    read = getattr(import_module(module), function)
    output = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # nothing else is printed between the arrays
    if sys.platform == "linux":
        import resource

        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MAX_MEMORY,) * 2)
    try:
        content = BytesIO()
        np.savez(content, **read(path))
    except MemoryError:
        sys.exit(f"it needs more than {MAX_MEMORY / 2**20:.0f} MiB of memory")
    except Exception as error:
        sys.exit(one_line(error) or type(error).__name__)
    output.write(content.getvalue())
    output.close()


if __name__ == "__main__":
    _main(*sys.argv[1:])
