"""Time of a step on one core, forward and with backward, compared with plain Taichi and with a former commit.

    pip install taichi                                          # 1.7.4, on no list of requirements
    taskset -c 0 python -m benchmarks.peers
    git worktree add ../former c62e703
    taskset -c 0 python -m benchmarks.peers --against ../former    # and with that commit of this project
    taskset -c 0 python -m benchmarks.peers --no-taichi --against ../former

A cube in free flight stretches and shears for 50 steps in float32. Each engine runs in its process, one at a time, and
all take turns in every round. Before times are printed, engines must agree in the final positions and in the gradient
of a random linear function of these with respect to the initial velocities. Only neo-Hookean cases run in Taichi
(`benchmarks.peer_taichi`), which has no walls and no checks of faults. Times are core seconds, which load disturbs less
than wall time. A ratio above 1 is slower than this checkout.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from multiprocessing import Pipe
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks import peer_engines
from benchmarks.peer_engines import Case
from benchmarks.timing import parser_of
from neuma_lib.errors import InputError

CASES = (
    Case("neo_hookean", 2197, 24),
    Case("neo_hookean", 19683, 64),
    Case("von_mises", 2197, 24),
    Case("structured", 2000, 24),
)
WORK = {"forward": "forward", "forward_backward": "with backward"}
OWN, OTHER, TAICHI = "this checkout", "other checkout", "taichi"
MAX_DISTANCE = 1e-5
"""Largest distance between the final positions of two engines [m]."""
MAX_GRADIENT_ERROR = 1e-3
"""Largest norm of the difference of two gradients, relative to the norm of ours."""

Result = tuple[np.ndarray, np.ndarray]
Times = dict[tuple[str, str], list[tuple[float, float]]]
"""Core and wall seconds of every round by engine and work."""


class Child:
    """An engine in its process, which imports `neuma_lib` from a checkout."""

    def __init__(self, name: str, checkout: Path):
        self.name = name
        self.connection, other = Pipe()
        paths = [str(checkout), *filter(None, [os.environ.get("PYTHONPATH")])]
        self.process = subprocess.Popen(
            # -P: without the folder of the script, which would hide packages of the other checkout
            [sys.executable, "-P", peer_engines.__file__, name, str(other.fileno())],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"},
            pass_fds=[other.fileno()],
            stdout=sys.stderr,
        )
        other.close()

    def prepare(self, case: Case) -> Result:
        """Final positions and gradient of a case, after compilation."""
        return self._answer(asdict(case))

    def seconds(self, work: str) -> tuple[float, float]:
        """Core and wall time of a method of `peer_engines.Engine`."""
        return self._answer(work)

    def _answer(self, order):
        try:
            self.connection.send(order)
            return self.connection.recv()
        except (EOFError, ConnectionError):
            raise RuntimeError(f"{self.name}: the process ended, see its error above") from None

    def close(self) -> None:
        """End the process."""
        if self.process.poll() is None:
            self.connection.send(None)
        self.process.wait()


def require_taichi() -> None:
    """Raise InputError without the package."""
    if importlib.util.find_spec("taichi") is None:
        raise InputError(
            "taichi",
            "the package is not installed",
            "Install it with `pip install taichi`, or use --no-taichi",
        )


def checked_checkout(path: Path) -> Path:
    """The folder of another checkout, or InputError."""
    path = path.resolve()
    if not (path / "neuma_lib/sim/rollout.py").exists():
        raise InputError("--against", f"{path} has no neuma_lib/sim/rollout.py", "Give a git worktree")
    return path


def differences(own: Result, other: Result) -> tuple[float, float]:
    """Largest distance of final positions [m], and relative error of the gradient."""
    (x, grad), (other_x, other_grad) = own, other
    error = np.linalg.norm(other_grad - grad) / np.linalg.norm(grad)
    return float(np.linalg.norm(other_x - x, axis=1).max()), float(error)


def agree(distance: float, error: float) -> bool:
    """Whether two engines simulate the same. False for NaN."""
    return distance <= MAX_DISTANCE and error <= MAX_GRADIENT_ERROR


def interleaved(engines: Sequence[Child], rounds: int) -> Times:
    """Times of all engines, which take turns in each round, in the opposite order in every second one."""
    times = {(engine.name, work): [] for work in WORK for engine in engines}
    for n in range(rounds):
        for work in WORK:
            for engine in engines[:: 1 if n % 2 == 0 else -1]:
                times[engine.name, work].append(engine.seconds(work))
    return times


def table(times: Times, steps: int) -> str:
    """Median and minimum of a step, and median and extremes of the paired ratio to this checkout, in core time."""
    lines = [f"{'a step [ms]':32}{'median':>9}{'minimum':>9}{'wall':>9}{'ratio':>8}   of rounds"]
    for (name, work), seconds in times.items():
        cores, walls = zip(*seconds, strict=True)
        ratios = [core / own for core, (own, _) in zip(cores, times[OWN, work], strict=True)]
        columns = "".join(f"{1e3 * t / steps:9.3f}" for t in (median(cores), min(cores), median(walls)))
        lines.append(
            f"{WORK[work]:16}{name:16}{columns}{median(ratios):8.2f}   {min(ratios):.2f} to {max(ratios):.2f}"
        )
    return "\n".join(lines)


def compare(case: Case, engines: Sequence[Child], rounds: int) -> str:
    """Agreement and times of a case. The first engine is this checkout.

    Raises:
        RuntimeError: engines do not simulate the same.
    """
    own, *others = (engine.prepare(case) for engine in engines)
    moved = np.linalg.norm(own[0] - case.arrays()[0], axis=1).max()
    lines = [f"{case.title}, {case.steps} steps, particles move up to {moved:.3f} m"]
    for engine, other in zip(engines[1:], others, strict=True):
        distance, error = differences(own, other)
        lines.append(f"  {engine.name}: positions differ by {distance:.1e} m, gradients by {error:.1e}")
        if not agree(distance, error):
            limits = f"at most {MAX_DISTANCE:g} m and {MAX_GRADIENT_ERROR:g}"
            raise RuntimeError(
                "\n".join([*lines, f"not the same simulation, which needs {limits}: no times"])
            )
    return "\n".join([*lines, table(interleaved(engines, rounds), case.steps)])


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--no-taichi", action="store_true")
    parser.add_argument("--against", type=Path, metavar="PATH", help="another checkout of this project")
    args = parser.parse_args()

    here = Path(__file__).resolve().parents[1]
    checkouts = {OWN: here}
    if args.against:
        checkouts[OTHER] = checked_checkout(args.against)
    if not args.no_taichi:
        require_taichi()
        checkouts[TAICHI] = here
    engines = [Child(name, checkout) for name, checkout in checkouts.items()]
    try:
        for case in CASES:
            able = [each for each in engines if each.name != TAICHI or case.law == "neo_hookean"]
            print(f"{compare(case, able, args.rounds)}\nload average {os.getloadavg()[0]:.1f}\n", flush=True)
    finally:
        for engine in engines:
            engine.close()


if __name__ == "__main__":
    main()
