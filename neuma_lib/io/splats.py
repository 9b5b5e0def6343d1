"""Gaussian splats of other programs, in common exchange formats.

- PLY of the 3DGS release (`neuma_lib.io.gaussians`), which image-to-3D models write, or compressed
  (`neuma_lib.io.compressed_splats`).
- ``.splat`` (github.com/antimatter15/splat): 32 bytes each, no higher harmonics.
- ``.spz`` (github.com/nianticlabs/spz), versions 1 to 3: 19 bytes each plus higher harmonics, compressed by gzip.

Coordinates are those of the file. No format defines the up direction.
"""

import struct
import zlib
from dataclasses import fields
from pathlib import Path

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.io.compressed_splats import is_compressed, unpacked
from neuma_lib.io.files import existing, reading
from neuma_lib.io.gaussians import checked_gaussians, load_gaussians
from neuma_lib.io.ply import read_elements
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.spherical_harmonics import MAX_DEGREE, SH_C0, coefficient_count

KINDS = (".ply", ".splat", ".spz")  # supported file suffixes
_REMEDY = "Remove it in a splat editor, or export the file again"
_SPLAT = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
_SPZ_HEADER = struct.Struct("<IIIBBBB")
"""Magic number, version, count, degree of harmonics, fractional bits of positions, flags, reserved."""
_SPZ_MAGIC = 0x5053474E
_SPZ_VERSIONS = (1, 2, 3)
_SPZ_EXTENSIONS = 2  # flag of extensions, which include other ranges of the harmonics
_SPZ_COLOUR = 0.15  # stored colour per unit of sh0
_MAX_INFLATION = 16  # maximum compression ratio; that of scans is 1 to 5, and that of gzip itself up to 1032
_ALWAYS_READ = 2**23  # unpacked size that is read at any ratio [bytes]


def load_splat(path: str | Path) -> Gaussians:
    """Read Gaussians in any format of this module, in float32, with unit quaternions.

    Raises:
        InputError: a damaged file or one of another format, no Gaussians, or values that are not finite.
    """
    path = existing(path, "Correct the path of the splat")
    kind = path.suffix.lower()
    if kind not in KINDS:
        raise InputError(path, f"must end in one of {', '.join(KINDS)}", "Convert it in a splat editor")
    if kind == ".ply":
        with reading(path, "a splat"):
            elements = read_elements(path)
            if not is_compressed(elements):
                loaded = load_gaussians(path, _REMEDY)
                arrays = {field.name: getattr(loaded, field.name).numpy() for field in fields(loaded)}
                return checked_gaussians(arrays, path, _REMEDY)
            return checked_gaussians(unpacked(elements), path, _REMEDY)
    with reading(path, f"a {kind} file"):
        arrays = (_read_splat if kind == ".splat" else _read_spz)(path)
        return checked_gaussians(arrays, path, _REMEDY)


def _read_splat(path: Path) -> dict[str, np.ndarray]:
    if path.stat().st_size % _SPLAT.itemsize:
        raise ValueError(f"{path.stat().st_size} bytes are not a multiple of {_SPLAT.itemsize}")
    rows = np.fromfile(path, _SPLAT)
    rgba = rows["rgba"] / 255
    return {
        "means": rows["mean"],
        "quats": (rows["quat"].astype(np.float64) - 128) / 128,
        "scales": rows["scale"],
        "opacities": rgba[:, 3],
        "sh0": ((rgba[:, :3] - 0.5) / SH_C0)[:, None, :],
        "shN": np.zeros((len(rows), 0, 3)),
    }


def _read_spz(path: Path) -> dict[str, np.ndarray]:
    packed = path.read_bytes()
    if packed[:4] == struct.pack("<I", _SPZ_MAGIC):
        raise InputError(path, "version 4 or later is not supported", "Export it as version 3 or PLY")
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    head = stream.decompress(packed, _SPZ_HEADER.size)
    magic, version, count, degree, fractional, flags, _ = _SPZ_HEADER.unpack(head)
    if magic != _SPZ_MAGIC:
        raise ValueError("it does not begin with NGSP")
    if version not in _SPZ_VERSIONS or degree > MAX_DEGREE or (degree and flags & _SPZ_EXTENSIONS):
        supported = f"{_SPZ_VERSIONS[0]} to {_SPZ_VERSIONS[-1]}, degree up to {MAX_DEGREE}, no extensions"
        problem = f"version {version} with degree {degree} and flags {flags} is not supported (versions {supported})"
        raise InputError(path, problem, "Export it as PLY")
    rest = coefficient_count(degree) - 1
    widths = {
        "means": 6 if version == 1 else 9, "opacities": 1, "sh0": 3, "scales": 3,
        "quats": 4 if version == 3 else 3, "shN": 3 * rest,
    }  # fmt: skip
    size = count * sum(widths.values())
    if size > max(_MAX_INFLATION * len(packed), _ALWAYS_READ):
        raise ValueError(
            f"its header claims {size} bytes ({count} Gaussians), too many for {len(packed)} packed ones"
        )
    body = stream.decompress(stream.unconsumed_tail, size) if size else b""
    if len(body) < size:
        raise ValueError(f"it ends after {len(body)} of {size} bytes")
    ends = np.cumsum([count * width for width in widths.values()])
    parts = np.split(np.frombuffer(body, np.uint8), ends[:-1])
    raw = {name: part.reshape(count, -1) for name, part in zip(widths, parts, strict=True)}
    if version == 1:
        means = raw["means"].view("<f2").astype(np.float64)
    else:
        means = _fixed_point(raw["means"]) / 2.0**fractional
    return {
        "means": means,
        "quats": _smallest_three(raw["quats"]) if version == 3 else _first_three(raw["quats"]),
        "scales": np.exp(raw["scales"] / 16 - 10),
        "opacities": raw["opacities"][:, 0] / 255,
        "sh0": ((raw["sh0"] / 255 - 0.5) / _SPZ_COLOUR)[:, None, :],
        "shN": (raw["shN"].reshape(count, rest, 3) - 128.0) / 128,
    }


def _fixed_point(bytes_: np.ndarray) -> np.ndarray:
    """Signed little-endian 24-bit integers (G, 3) from bytes (G, 9)."""
    low, middle, high = bytes_.reshape(-1, 3, 3).astype(np.int64).transpose(2, 0, 1)
    value = low | (middle << 8) | (high << 16)
    return value - ((value & 0x800000) << 1)


def _first_three(bytes_: np.ndarray) -> np.ndarray:
    """Quaternions (G, 4), w first, from x, y, z as bytes (G, 3); w >= 0 follows from the norm."""
    xyz = bytes_ / 127.5 - 1
    return np.column_stack([np.sqrt(np.maximum(0.0, 1 - np.square(xyz).sum(axis=1))), xyz])


def _smallest_three(bytes_: np.ndarray) -> np.ndarray:
    """Quaternions (G, 4), w first: 2 bits name the largest of x, y, z, w; 3 x 10 bits are sign and size of the rest."""
    words = np.ascontiguousarray(bytes_).view("<u4")[:, 0].astype(np.int64)
    largest, rows = words >> 30, np.arange(len(words))
    xyzw = np.zeros((len(words), 4))
    for k in (3, 2, 1, 0):  # the last component is in the lowest bits
        stored = largest != k
        value = (words & 511) / 511 * np.sqrt(0.5) * np.where(words & 512, -1.0, 1.0)
        xyzw[stored, k] = value[stored]
        words = np.where(stored, words >> 10, words)
    xyzw[rows, largest] = np.sqrt(np.maximum(0.0, 1 - np.square(xyzw).sum(axis=1)))
    return xyzw[:, [3, 0, 1, 2]]
