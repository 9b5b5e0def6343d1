"""Time of a step, forward and with gradients, compared with Taichi, Genesis, newton and a former commit.

    pip install taichi genesis-world "newton[sim]"               # 1.7.4, 1.4.5, 1.8.0; docs/engines.md
    taskset -c 0 python -m benchmarks.peers                       # those that are installed, on one core
    python -m benchmarks.peers --device cuda                      # on a GPU
    git worktree add ../former c62e703
    taskset -c 0 python -m benchmarks.peers --peers --against ../former     # that commit of this project only

A cube in free flight stretches and shears for 50 steps in float32. Each engine runs in its process, one at a time,
and all take turns in every round. Engines run the cases whose law they have: Taichi (`benchmarks.peer_taichi`,
without walls and checks of faults) neo-Hookean, Genesis also fixed-corotated with von Mises, newton Hencky with von
Mises. Before times are printed, engines must agree in the final positions and in the gradient of a random linear
function of these with respect to the initial velocities. newton's implicit steps have no gradient and only
approximately the same positions.

Times on a CPU are core seconds, which load disturbs less than wall time. A ratio above 1 is slower than this checkout.
"""

import importlib.util
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from multiprocessing import Pipe
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np

from benchmarks import peer_engines
from benchmarks.peer_engines import Case
from benchmarks.timing import parser_of
from neuma_lib.errors import InputError

CASES = {
    "cpu": (
        Case("neo_hookean", 2197, 24),
        Case("neo_hookean", 19683, 64),
        Case("von_mises", 2197, 24),
        Case("corotated_von_mises", 2197, 24),
        Case("structured", 2000, 24),
    ),
    "cuda": (
        Case("neo_hookean", 19683, 64),
        Case("neo_hookean", 262144, 128),
        Case("von_mises", 19683, 64),
        Case("von_mises", 262144, 128),
        Case("corotated_von_mises", 262144, 128),
    ),
}
WORK = {"forward": "forward", "forward_backward": "with backward"}
OWN, OTHER = "this checkout", "other checkout"
MAX_GRADIENT_ERROR = 1e-3
"""Largest norm of the difference of two gradients, relative to the norm of ours."""


class Peer(NamedTuple):
    """What an engine can do.

    Attributes:
        laws: of the cases that it runs. None: all.
        works: keys of `WORK`.
        distance: between its final positions and ours, at most [m].
    """

    laws: tuple[str, ...] | None = None
    works: tuple[str, ...] = tuple(WORK)
    distance: float = 1e-5


PEERS = {
    "taichi": Peer(("neo_hookean",)),
    "genesis": Peer(("neo_hookean", "corotated_von_mises")),
    "newton": Peer(("von_mises",), ("forward",), 5e-3),
}

Result = tuple[np.ndarray, np.ndarray | None]
Times = dict[tuple[str, str], list[tuple[float, float]]]
"""Core and wall seconds of every round by engine and work."""


class Child:
    """An engine in its process, which imports `neuma_lib` from a checkout."""

    def __init__(self, name: str, checkout: Path, device: str = "cpu"):
        self.name, self.peer = name, PEERS.get(name, Peer())
        self.connection, other = Pipe()
        paths = [str(checkout), *filter(None, [os.environ.get("PYTHONPATH")])]
        self.process = subprocess.Popen(
            # -P: without the folder of the script, which would hide packages of the other checkout
            [sys.executable, "-P", peer_engines.__file__, name, device, str(other.fileno())],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"},
            pass_fds=[other.fileno()],
            stdout=sys.stderr,
        )
        other.close()

    def prepare(self, case: Case) -> Result:
        """Final positions and gradient of a case, after compilation."""
        return self._answer((self.peer.works[-1], asdict(case)))

    def seconds(self, work: str) -> tuple[float, float]:
        """Core and wall time of a method of `peer_engines.Rollout`."""
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


def installed(names: Sequence[str] | None) -> list[str]:
    """The named peers, or all that are installed. Raises InputError for one that is not."""
    there = [name for name in PEERS if importlib.util.find_spec(name) is not None]
    for name in names or ():
        if name not in there:
            raise InputError(name, "the package is not installed", "Install it, or name other --peers")
    return there if names is None else list(names)


def checked_checkout(path: Path) -> Path:
    """The folder of another checkout, or InputError."""
    path = path.resolve()
    if not (path / "neuma_lib/sim/rollout.py").exists():
        raise InputError("--against", f"{path} has no neuma_lib/sim/rollout.py", "Give a git worktree")
    return path


def differences(own: Result, other: Result) -> tuple[float, float]:
    """Largest distance of final positions [m], and relative error of the gradient, which is 0 if there is none."""
    (x, grad), (other_x, other_grad) = own, other
    error = 0.0
    if grad is not None and other_grad is not None:
        error = float(np.linalg.norm(other_grad - grad) / np.linalg.norm(grad))
    return float(np.linalg.norm(other_x - x, axis=1).max()), error


def agree(distance: float, error: float, peer: Peer = PEERS["taichi"]) -> bool:
    """Whether two engines simulate the same. False for NaN."""
    return distance <= peer.distance and error <= MAX_GRADIENT_ERROR


def interleaved(engines: Sequence[Child], rounds: int) -> Times:
    """Times of all engines, which take turns in each round, in the opposite order in every second one."""
    times = {(engine.name, work): [] for work in WORK for engine in engines if work in engine.peer.works}
    for n in range(rounds):
        for work in WORK:
            for engine in engines[:: 1 if n % 2 == 0 else -1]:
                if work in engine.peer.works:
                    times[engine.name, work].append(engine.seconds(work))
    return times


def table(times: Times, steps: int, clock: int = 0) -> str:
    """Median and minimum of a step, and median and extremes of the paired ratio to this checkout.

    Args:
        clock: 0 for core time, 1 for wall time. The other median is printed too.
    """
    words = ("core", "wall")[:: 1 - 2 * clock]
    lines = [
        f"{'a step [ms], ' + words[0]:32}{'median':>9}{'minimum':>9}{words[1]:>9}{'ratio':>8}   of rounds"
    ]
    for (name, work), seconds in times.items():
        own, other = ([pair[k] for pair in seconds] for k in (clock, 1 - clock))
        ratios = [t / mine[clock] for t, mine in zip(own, times[OWN, work], strict=True)]
        columns = "".join(f"{1e3 * t / steps:9.3f}" for t in (median(own), min(own), median(other)))
        lines.append(
            f"{WORK[work]:16}{name:16}{columns}{median(ratios):8.2f}   {min(ratios):.2f} to {max(ratios):.2f}"
        )
    return "\n".join(lines)


def compare(case: Case, engines: Sequence[Child], rounds: int, clock: int = 0) -> str:
    """Agreement and times of a case. The first engine is this checkout.

    Raises:
        RuntimeError: engines do not simulate the same.
    """
    own, *others = (engine.prepare(case) for engine in engines)
    moved = np.linalg.norm(own[0] - case.arrays()[0], axis=1).max()
    lines = [f"{case.title}, {case.steps} steps, particles move up to {moved:.3f} m"]
    for engine, other in zip(engines[1:], others, strict=True):
        distance, error = differences(own, other)
        gradients = "no gradient" if other[1] is None else f"gradients by {error:.1e}"
        lines.append(f"  {engine.name}: positions differ by {distance:.1e} m, {gradients}")
        if not agree(distance, error, engine.peer):
            limits = f"at most {engine.peer.distance:g} m and {MAX_GRADIENT_ERROR:g}"
            problem = "\n".join([*lines, f"not the same simulation, which needs {limits}: no times"])
            raise RuntimeError(problem)
    return "\n".join([*lines, table(interleaved(engines, rounds), case.steps, clock)])


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--device", choices=list(CASES), default="cpu")
    peers = "engines (default: all that are installed; nothing after it: none)"
    parser.add_argument("--peers", nargs="*", metavar="NAME", choices=list(PEERS), help=peers)
    parser.add_argument("--against", type=Path, metavar="PATH", help="another checkout of this project")
    args = parser.parse_args()

    here = Path(__file__).resolve().parents[1]
    checkouts = {OWN: here}
    if args.against:
        checkouts[OTHER] = checked_checkout(args.against)
    checkouts |= dict.fromkeys(installed(args.peers), here)
    engines = [Child(name, checkout, args.device) for name, checkout in checkouts.items()]
    try:
        for case in CASES[args.device]:
            able = [each for each in engines if each.peer.laws is None or case.law in each.peer.laws]
            result = compare(case, able, args.rounds, int(args.device == "cuda"))
            print(f"{result}\nload average {os.getloadavg()[0]:.1f}\n", flush=True)
    finally:
        for engine in engines:
            engine.close()


if __name__ == "__main__":
    main()
