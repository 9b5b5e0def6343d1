"""Compare the results of two runs, file by file: ``python -m tests.support.same_results A B``.

A and B are folders of results or data. Logs, benchmarks and checkpoints are left out. Files are equal if their bytes
are equal. With ``--values``, HDF5, NPZ, safetensors and PNG files are equal if their arrays are, and JSON files if
their contents are: metadata, which repeat settings and commits, may then differ.

The exit status is 0 if no file differs and both folders have the same files.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import h5py
import numpy as np
from PIL import Image
from safetensors.numpy import load_file

LEFT_OUT = {"logs", "benchmarks"}


def artifacts(root: Path) -> dict[str, Path]:
    """Files of a run by their path below its folder."""
    files = (file for file in root.rglob("*") if file.is_file() and "checkpoint" not in file.name)
    names = {str(file.relative_to(root)): file for file in files}
    return {name: file for name, file in sorted(names.items()) if not LEFT_OUT & set(Path(name).parts)}


def same_bytes(a: Path, b: Path) -> bool:
    return a.stat().st_size == b.stat().st_size and a.read_bytes() == b.read_bytes()


def same_values(a: Path, b: Path) -> bool:
    """Whether two files hold the same arrays or, if they are not of a known format, the same bytes."""
    read = READERS.get(a.suffix)
    if read is None or same_bytes(a, b):
        return same_bytes(a, b)
    one, other = read(a), read(b)
    return one.keys() == other.keys() and all(_equal(one[key], other[key]) for key in one)


def _equal(a, b) -> bool:
    if isinstance(a, np.ndarray) and a.dtype.kind == "f":
        return np.array_equal(a, b, equal_nan=True)
    return np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b


def _hdf5(path: Path) -> dict[str, np.ndarray]:
    arrays = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, item: arrays.update({name: item[()]} if hasattr(item, "shape") else {}))
    return arrays


READERS = {
    ".h5": _hdf5,
    ".npz": lambda path: dict(np.load(path)),
    ".safetensors": load_file,
    ".png": lambda path: {"image": np.asarray(Image.open(path))},
    ".json": lambda path: {"json": json.loads(path.read_text())},
}


def compare(a: Path, b: Path, values: bool = False) -> dict[str, list[str]]:
    """Names of files that are equal, that differ, and that only one run has."""
    one, other = artifacts(a), artifacts(b)
    same = same_values if values else same_bytes
    result = {"equal": [], "differs": []}
    for name in sorted(one.keys() & other.keys()):
        result["equal" if same(one[name], other[name]) else "differs"].append(name)
    return result | {
        f"only in {a}": sorted(one.keys() - other.keys()),
        f"only in {b}": sorted(other.keys() - one.keys()),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("a", type=Path, help="folder of the first run")
    parser.add_argument("b", type=Path, help="folder of the second run")
    parser.add_argument("--values", action="store_true", help="compare arrays, not bytes")
    options = parser.parse_args()
    result = compare(options.a, options.b, options.values)
    equal = result.pop("equal")
    for kind, names in result.items():
        for name in names:
            print(f"{kind}: {name}")
    print(f"{len(equal)} files are equal, {len(result['differs'])} differ")
    return int(any(result.values()))


if __name__ == "__main__":
    raise SystemExit(main())
