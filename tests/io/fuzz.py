"""Seeded mutations of valid files, for every reader of files: a reader returns or raises InputError, and nothing else.

`python -m tests.io.fuzz --mutations 20000` prints what happened in each reader. A case is the number of its reader and
mutation, so `--only NAME --first 1234 --mutations 1` repeats it, with the traceback.

Readers run in forked children with a limit of memory and time. A child that dies is counted, and a new one continues.
"""

from __future__ import annotations

import argparse
import gzip
import io
import json
import os
import random
import re
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from neuma_lib.errors import InputError

SECONDS = 5
"""Limit of a case."""
MEMORY = 500 * 2**20
"""Address space that a child may add [bytes]."""

Mutation = Callable[[bytes, random.Random], bytes]


@dataclass
class Reader:
    """A reader, with a valid file.

    Attributes:
        read: call with the path of the file, which raises unless the result is valid.
        path: the valid file, which mutations replace.
        unpack, pack: bytes behind a checksum or a compression, which are mutated in half of the cases.
        is_text: mutate values of JSON.
        is_slow: one case takes more than 20 ms; CI does a tenth of the mutations.
    """

    name: str
    read: Callable[[Path], object]
    path: Path
    unpack: Callable[[bytes], bytes] | None = None
    pack: Callable[[bytes, bytes], bytes] | None = None
    is_text: bool = False
    is_slow: bool = False


@dataclass
class Outcome:
    """What a reader did: numbers of cases by outcome, first case of each failure, and the largest costs."""

    counts: Counter = field(default_factory=Counter)
    failures: dict[str, int] = field(default_factory=dict)
    seconds: float = 0.0
    longest: float = 0.0
    peak: int = 0

    def add(self, outcome: str, case: int, seconds: float) -> None:
        self.counts[outcome] += 1
        self.longest = max(self.longest, seconds)
        if outcome not in ("read", "refused"):
            self.failures.setdefault(outcome, case)


# ---- mutations

EXTREMES = [
    0, 1, -1, 127, 128, 255, 256, 2**15, 2**16 - 1, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, -2**31
]  # fmt: skip
VALUES = [
    None, True, False, 0, -1, 2**31, 2**63, 10**400, 1e308, -1e308, 1e-320, float("nan"), float("inf"), "", "text", "1",
    "../..", "\0", "\ud800", [], [[]], {}, [None], [0] * 3, [1e308] * 3, ["a"] * 3, {"a": 1}, [[0] * 3] * 3
]  # fmt: skip
NUMBER = re.compile(rb"-?\d+(?:\.\d*)?(?:e[-+]?\d+)?")
WORDS = [
    b"0",
    b"-1",
    b"4294967296",
    b"9" * 20,
    b"9" * 5000,
    b"1e999",
    b"nan",
    b"inf",
    b"true",
    b"[]",
    b'"a"',
    b"null",
    b"",
]


def mutated(content: bytes, rng: random.Random, headers: list[bytes]) -> bytes:
    """One to three random changes of bytes."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        kind, size = rng.randrange(8), max(1, len(data))
        # headers are at the start, and most of a file is data
        at = min(rng.randrange(size), rng.choice((64, 512, 4096, size)) - 1)
        if kind == 0:
            for _ in range(rng.choice((1, 1, 4, 32))):
                at = rng.randrange(size)
                data[at : at + 1] = bytes([data[at] ^ (1 << rng.randrange(8))]) if data else b"\0"
        elif kind == 1:
            del data[at:]
        elif kind in (2, 3):
            value, width = rng.choice(EXTREMES), rng.choice((1, 2, 4, 8))
            data[at : at + width] = (value % 2 ** (8 * width)).to_bytes(width, rng.choice(("little", "big")))
        elif kind == 4:
            header = rng.choice(headers)[: rng.choice((4, 16, 64))]
            data[: len(header)] = header
        elif kind == 5:
            length = rng.choice((1, 7, 64, 1000))
            data[at : at + rng.choice((0, length))] = (
                rng.choice((b"\0", b"\xff", bytes(data[:9]) or b"a")) * length
            )
        elif kind == 6:
            del data[at : at + rng.choice((1, 4, 100))]
        elif numbers := list(NUMBER.finditer(data, max(0, at - 200), at + 200)):
            span = rng.choice(numbers)
            data[span.start() : span.end()] = rng.choice(WORDS)
    return bytes(data)


def mutated_json(content: bytes, rng: random.Random) -> bytes:
    """Another value, a missing or a repeated entry in a random place of a JSON text."""
    places: list[tuple[object, object]] = []

    def walk(value: object) -> None:
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            places.append((value, key))
            if isinstance(part, dict | list):
                walk(part)

    data = json.loads(content)
    walk(data)
    for _ in range(rng.choice((1, 1, 2))):
        inside, key = rng.choice(places)
        if rng.random() < 0.25:
            inside.pop(key, None) if isinstance(inside, dict) else inside[key % max(1, len(inside)) :].clear()
        elif isinstance(inside, dict) or key < len(inside):
            inside[key] = rng.choice(VALUES)
    return json.dumps(data).encode()


def case(reader: Reader, number: int, content: bytes, headers: list[bytes]) -> bytes:
    """The file of a case."""
    rng = random.Random(f"{reader.name} {number}")
    if reader.is_text and rng.random() < 0.6:
        return mutated_json(content, rng)
    if reader.pack and rng.random() < 0.6:
        return reader.pack(content, mutated(reader.unpack(content), rng, headers))
    return mutated(content, rng, headers)


# ---- packing


def gunzip(content: bytes) -> bytes:
    return gzip.decompress(content)


def regzip(_: bytes, inner: bytes) -> bytes:
    return gzip.compress(inner, 1, mtime=0)


def pickle_of(content: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return next(archive.read(name) for name in archive.namelist() if name.endswith("data.pkl"))


def with_pickle(content: bytes, inner: bytes) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(made, "w") as new:
        for name in old.namelist():
            new.writestr(zipfile.ZipInfo(name), inner if name.endswith("data.pkl") else old.read(name))
    return made.getvalue()


def header_of(content: bytes) -> bytes:
    """The JSON of a safetensors file."""
    return content[8 : 8 + struct.unpack_from("<Q", content)[0]]


def with_header(content: bytes, inner: bytes) -> bytes:
    return struct.pack("<Q", len(inner)) + inner + content[8 + len(header_of(content)) :]


# ---- running


def run(reader: Reader, numbers: range, headers: list[bytes], verbose: bool = False) -> Outcome:
    """Read the files of some cases in children."""
    content, outcome, started = reader.path.read_bytes(), Outcome(), time.monotonic()
    try:
        reader.read(reader.path)  # also imports what it needs
        left = list(numbers)
        while left:
            left = left[_batch(reader, left, content, headers, outcome, verbose) :]
    finally:
        reader.path.write_bytes(content)
    outcome.seconds = time.monotonic() - started
    return outcome


def _batch(reader, numbers, content, headers, outcome: Outcome, verbose: bool) -> int:
    """Cases in one child, until it dies. Returns how many ended."""
    source, sink = os.pipe()
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        try:
            os.close(source)
            _work(reader, numbers, content, headers, os.fdopen(sink, "w", buffering=1), verbose)
        finally:
            os._exit(0)
    os.close(sink)
    done = 0
    with os.fdopen(source) as lines:
        for line in lines:
            what, seconds = line.rstrip("\n").rsplit("\t", 1)
            outcome.add(what, numbers[done], float(seconds))
            done += 1
    _, status, usage = os.wait4(child, 0)
    outcome.peak = max(outcome.peak, usage.ru_maxrss * 1024)
    if done < len(numbers):
        signalled = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        what = (
            "slow"
            if signalled == signal.SIGALRM
            else f"crash: {signal.Signals(signalled).name}"
            if signalled
            else "exit"
        )
        outcome.add(what, numbers[done], float(SECONDS) if what == "slow" else 0.0)
        done += 1
    return done


def _work(reader, numbers, content, headers, sink, verbose: bool) -> None:
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    if not verbose:
        quiet = os.open(os.devnull, os.O_WRONLY)
        os.dup2(quiet, 1)
        os.dup2(quiet, 2)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for number in numbers:
        reader.path.unlink(missing_ok=True)
        reader.path.write_bytes(case(reader, number, content, headers))
        signal.alarm(SECONDS)
        started = time.monotonic()
        try:
            reader.read(reader.path)
            what = "read"
        except InputError as error:
            cause = error.__context__
            # all wrong settings are listed together
            is_clear = reader.path.suffix == ".yaml" or len(str(error).splitlines()) == 1
            what = "memory" if isinstance(cause, MemoryError) else "refused" if is_clear else "several lines"
        except MemoryError:
            what = "memory"
        except BaseException as error:
            frames = [f for f in traceback.extract_tb(error.__traceback__) if "neuma_lib" in f.filename]
            what = (
                f"{type(error).__name__} in {Path(frames[-1].filename).name}:{frames[-1].lineno}"
                if frames
                else repr(error)
            )
            what = " ".join(what.split())[:100]
            if verbose:
                traceback.print_exc()
        signal.alarm(0)
        sink.write(f"{what}\t{time.monotonic() - started}\n")


def all_readers(folder: Path) -> list[Reader]:
    """All readers, with valid files in new subfolders."""
    from tests.io import fuzz_samples

    return fuzz_samples.readers(folder)


def outcomes(
    readers: list[Reader], mutations: int, first: int = 0, slow_share: float = 1.0, verbose: bool = False
) -> Iterator[tuple[Reader, Outcome]]:
    """Outcomes of all readers, each after its last case."""
    headers = [reader.path.read_bytes()[:64] for reader in readers]
    for reader in readers:
        count = max(1, round(mutations * (slow_share if reader.is_slow else 1)))
        yield reader, run(reader, range(first, first + count), headers, verbose)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mutations", type=int, default=200, help="of each reader (default %(default)s)")
    parser.add_argument("--first", type=int, default=0, help="number of the first mutation")
    parser.add_argument("--only", nargs="*", help="parts of the names of readers")
    parser.add_argument(
        "--slow-share", type=float, default=0.1, help="share of the mutations for slow readers"
    )
    parser.add_argument("--verbose", action="store_true", help="print tracebacks")
    options = parser.parse_args()
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        readers = all_readers(Path(folder))
        headers = [reader.path.read_bytes()[:64] for reader in readers]
        print("| reader | cases | read | refused | failures | seconds | longest [s] | peak [MB] |")
        print("|---|---|---|---|---|---|---|---|", flush=True)
        for reader in readers:
            if options.only and not any(part in reader.name for part in options.only):
                continue
            count = max(1, round(options.mutations * (options.slow_share if reader.is_slow else 1)))
            numbers = range(options.first, options.first + count)
            result = run(reader, numbers, headers, options.verbose)
            bad = sum(result.counts.values()) - result.counts["read"] - result.counts["refused"]
            failed += bad
            cells = (
                reader.name,
                count,
                result.counts["read"],
                result.counts["refused"],
                bad,
                f"{result.seconds:.0f}",
            )
            print(
                "|",
                " | ".join(map(str, cells)),
                f"| {result.longest:.2f} | {result.peak / 2**20:.0f} |",
                flush=True,
            )
            for what, number in result.failures.items():
                print(f"    {result.counts[what]} x {what}, first in case {number}", flush=True)
    print(f"{failed} failures")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
