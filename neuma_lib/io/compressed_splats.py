"""Gaussians as compressed PLY in the layout of PlayCanvas (SuperSplat): 16 bytes each, plus higher harmonics.

Element ``chunk`` has, for every 256 Gaussians, the ranges of their positions, log scales and colours. Element
``vertex`` has four 32-bit words quantised in these ranges: position and log scale (11, 10, 11 bits), rotation (2 bits
name the largest component, 3 x 10 bits hold the others), colour and opacity (8 bits each). Element ``sh`` has one byte
for each coefficient of the higher harmonics, by channel.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from neuma_lib.io.gaussians import REST_COUNTS
from neuma_lib.io.ply import write_elements
from neuma_lib.splatting.culling import morton_order
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.spherical_harmonics import SH_C0

CHUNK = 256  # Gaussians with common ranges
_RANGES = [f"{end}_{of}{axis}" for of in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
_COLOURS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
_WORDS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_SH_RANGE = 8.0  # width of the range of a higher coefficient, centred at zero
_SQRT2 = np.sqrt(2.0)


def is_compressed(elements: Mapping[str, np.ndarray]) -> bool:
    """Whether the elements of a PLY file have this layout."""
    return "chunk" in elements and set(_WORDS) <= set(elements["vertex"].dtype.names)


def unpacked(elements: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays of `Gaussians` by name, float32, from the elements of a PLY file of this layout.

    Raises:
        ValueError: inconsistent elements.
    """
    chunks, rows = elements["chunk"], elements["vertex"]
    if missing := [name for name in _RANGES if name not in chunks.dtype.names]:
        raise ValueError(f"the element chunk has no {', '.join(missing)}")
    if not (len(chunks) - 1) * CHUNK < len(rows) <= len(chunks) * CHUNK:
        raise ValueError(f"{len(chunks)} chunks of {CHUNK} do not match {len(rows)} Gaussians")
    chunks = chunks[np.arange(len(rows)) // CHUNK]
    position, rotation, scale, colour = (rows[name].astype(np.uint32) for name in _WORDS)
    means = _between(chunks, _RANGES[:6], _bits(position, (11, 10, 11)))
    scales = np.exp(_between(chunks, _RANGES[6:], _bits(scale, (11, 10, 11))))
    rgba = _bits(colour, (8, 8, 8, 8))
    rgb = rgba[:, :3]
    if set(_COLOURS) <= set(chunks.dtype.names):  # older files have no ranges of colours
        rgb = _between(chunks, _COLOURS, rgb)
    rest = np.zeros((len(rows), 0))
    if "sh" in elements:
        columns = elements["sh"].dtype.names
        if len(columns) not in REST_COUNTS or len(elements["sh"]) != len(rows):
            problem = f"{len(columns)} coefficients of {len(elements['sh'])} Gaussians, not {len(rows)}"
            raise ValueError(problem)
        rest = np.stack([elements["sh"][f"f_rest_{i}"] for i in range(len(columns))], axis=1)
        rest = rest * (_SH_RANGE / 255) - _SH_RANGE / 2
    arrays = {
        "means": means,
        "quats": _unpacked_rotations(rotation),
        "scales": scales,
        "opacities": rgba[:, 3],
        "sh0": ((rgb - 0.5) / SH_C0)[:, None, :],
        "shN": np.swapaxes(rest.reshape(len(rows), 3, -1), 1, 2),
    }
    return {name: np.ascontiguousarray(array, dtype=np.float32) for name, array in arrays.items()}


def save_compressed(path: str | Path, gaussians: Gaussians, order: np.ndarray | None = None) -> None:
    """Write Gaussians as compressed PLY.

    The resolution is the chunk's extent over 2047 (y: 1023) for positions and log scales, about 1e-3 for rotations,
    1/255 for colours and opacities and 1/32 for harmonics, which are clipped to [-4, 4].

    Args:
        gaussians: at least one.
        order: (G,) order in which they are written; None: `morton_order`, which keeps the chunks compact.
    """
    g = gaussians.to("cpu", torch.float64)
    arrays = [
        getattr(g, name).detach().numpy() for name in ("means", "scales", "quats", "sh0", "shN", "opacities")
    ]
    order = morton_order(arrays[0]) if order is None else order
    means, scales, quats, sh0, shN, opacities = (array[order] for array in arrays)
    count = len(means)
    starts = np.arange(0, count, CHUNK)
    rgb = sh0[:, 0] * SH_C0 + 0.5
    chunks = np.empty(len(starts), dtype=[(name, "<f4") for name in (*_RANGES, *_COLOURS)])
    parts = []
    for names, values in zip((_RANGES[:6], _RANGES[6:], _COLOURS), (means, np.log(scales), rgb), strict=True):
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        for name, column in zip(names, np.hstack([low, high]).T, strict=True):
            chunks[name] = column
        low, high = (np.repeat(end, CHUNK, axis=0)[:count] for end in (low, high))
        parts.append((values - low) / np.where(high > low, high - low, 1.0))
    rows = np.empty(count, dtype=[(name, "<u4") for name in _WORDS])
    rows["packed_position"] = _words(parts[0], (11, 10, 11))
    rows["packed_rotation"] = _packed_rotations(quats)
    rows["packed_scale"] = _words(parts[1], (11, 10, 11))
    rows["packed_color"] = _words(np.column_stack([parts[2], opacities]), (8, 8, 8, 8))
    elements = {"chunk": chunks, "vertex": rows}
    if shN.shape[1]:
        rest = np.swapaxes(shN, 1, 2).reshape(count, -1)
        elements["sh"] = np.empty(count, dtype=[(f"f_rest_{i}", "u1") for i in range(rest.shape[1])])
        for i, column in enumerate(rest.T):
            elements["sh"][f"f_rest_{i}"] = np.clip((column / _SH_RANGE + 0.5) * 255, 0, 255).round()
    write_elements(path, elements)


def _bits(words: np.ndarray, widths: tuple[int, ...]) -> np.ndarray:
    """Fields (G, n) in [0, 1] of 32-bit words, the first in the highest bits."""
    shifts = 32 - np.cumsum(widths)
    return np.stack(
        [((words >> np.uint32(s)) & (2**w - 1)) / (2**w - 1) for s, w in zip(shifts, widths, strict=True)],
        axis=1,
    )


def _words(fields: np.ndarray, widths: tuple[int, ...]) -> np.ndarray:
    """Inverse of `_bits`."""
    words = np.zeros(len(fields), np.uint32)
    for column, width, shift in zip(fields.T, widths, 32 - np.cumsum(widths), strict=True):
        words |= (np.clip(column, 0, 1) * (2**width - 1)).round().astype(np.uint32) << np.uint32(shift)
    return words


def _between(chunks: np.ndarray, names: list[str], part: np.ndarray) -> np.ndarray:
    """Values (G, 3) from fractions of the ranges of their chunks; names of three minima, then three maxima."""
    low, high = (np.stack([chunks[name] for name in ends], axis=1) for ends in (names[:3], names[3:]))
    return low * (1 - part) + high * part


def _unpacked_rotations(words: np.ndarray) -> np.ndarray:
    """Unit quaternions (G, 4), w first; the largest component follows from the norm."""
    others = (_bits(words << np.uint32(2), (10, 10, 10, 2))[:, :3] - 0.5) * _SQRT2
    largest = (words >> np.uint32(30)).astype(np.int64)
    quats = np.empty((len(words), 4))
    rows = np.arange(len(words))
    quats[rows, largest] = np.sqrt(np.maximum(0.0, 1 - np.square(others).sum(axis=1)))
    quats[rows[:, None], _other_components(largest)] = others
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def _packed_rotations(quats: np.ndarray) -> np.ndarray:
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    rows = np.arange(len(quats))
    largest = np.abs(quats).argmax(axis=1)
    quats = quats * np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = quats[rows[:, None], _other_components(largest)] / _SQRT2 + 0.5
    return (_words(others, (10, 10, 10)) >> np.uint32(2)) | (largest.astype(np.uint32) << np.uint32(30))


def _other_components(largest: np.ndarray) -> np.ndarray:
    """Indices (G, 3) of all components of a quaternion but the largest."""
    return np.array([[j for j in range(4) if j != k] for k in range(4)])[largest]
