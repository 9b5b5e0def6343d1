"""Small splats, and writers of the exchange formats, one Gaussian at a time, after their specifications."""

import gzip
import math
import struct

import numpy as np
import torch

from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.spherical_harmonics import SH_C0


def ball(count=600, radius=1.0, degree=0, seed=0, centre=(0.0, 0.0, 0.0)):
    """Opaque Gaussians that fill a ball, with random shapes and colours."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    means = np.asarray(centre) + radius * direction * np.cbrt(rng.random((count, 1)))
    spacing = radius * (4 * math.pi / 3 / count) ** (1 / 3)
    quats = rng.normal(size=(count, 4))
    arrays = {
        "means": means,
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": spacing * rng.uniform(0.4, 0.8, (count, 3)),
        "opacities": rng.uniform(0.5, 0.95, count),
        "sh0": rng.uniform(-1.5, 1.5, (count, 1, 3)),
        "shN": rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2 - 1, 3)),
    }
    return Gaussians(**{name: torch.from_numpy(a).float() for name, a in arrays.items()})


def rows_of(gaussians):
    fields = ("means", "quats", "scales", "opacities", "sh0", "shN")
    return zip(*(getattr(gaussians, name).double().tolist() for name in fields), strict=True)


def level(value, maximum):
    return int(min(max(round(value), 0), maximum))


def write_splat(path, gaussians):
    with open(path, "wb") as file:
        for mean, quat, scale, opacity, sh0, _ in rows_of(gaussians):
            rgba = [level(255 * (0.5 + SH_C0 * c), 255) for c in sh0[0]] + [level(255 * opacity, 255)]
            file.write(struct.pack("<6f8B", *mean, *scale, *rgba, *(level(128 + 128 * q, 255) for q in quat)))


def write_spz(path, gaussians, version=3, fractional=12, degree=0, flags=0, count=None):
    parts = {name: bytearray() for name in ("positions", "alphas", "colours", "scales", "rotations", "sh")}
    for mean, (w, x, y, z), scale, opacity, sh0, shN in rows_of(gaussians):
        for value in mean:
            if version == 1:
                parts["positions"] += struct.pack("<e", value)
            else:
                parts["positions"] += struct.pack("<i", round(value * 2**fractional))[:3]
        parts["alphas"].append(level(255 * opacity, 255))
        parts["colours"] += bytes(level(255 * (0.15 * c + 0.5), 255) for c in sh0[0])
        parts["scales"] += bytes(level(16 * (math.log(s) + 10), 255) for s in scale)
        q = [x, y, z, w]
        if version < 3:
            parts["rotations"] += bytes(level(127.5 * (1 + math.copysign(1, w) * c), 255) for c in q[:3])
        else:
            largest = max(range(4), key=lambda k: abs(q[k]))
            word = largest
            for k in set(range(4)) - {largest}:
                size = int(511 * abs(q[k]) * math.sqrt(2) + 0.5)
                word = word << 10 | ((q[k] < 0) != (q[largest] < 0)) << 9 | size
            parts["rotations"] += struct.pack("<I", word)
        parts["sh"] += bytes(level(128 * c + 128, 255) for rgb in shN for c in rgb)
    header = struct.pack(
        "<IIIBBBB", 0x5053474E, version, count or len(gaussians), degree, fractional, flags, 0
    )
    path.write_bytes(gzip.compress(header + b"".join(map(bytes, parts.values()))))


def write_compressed(path, gaussians, old=False):
    """Compressed PLY, in the order of the Gaussians; ``old`` files have no ranges of colours."""
    rows = list(rows_of(gaussians))
    chunks, words, harmonics = [], [], bytearray()
    for start in range(0, len(rows), 256):
        block = rows[start : start + 256]
        values = [
            [*mean, *map(math.log, scale), *(0.5 + SH_C0 * c for c in sh0[0])]
            for mean, _, scale, _, sh0, _ in block
        ]
        low, high = np.min(values, axis=0), np.max(values, axis=0)
        chunks.append([*low[:3], *high[:3], *low[3:6], *high[3:6], *([] if old else [*low[6:], *high[6:]])])
        for row, value in zip(block, values, strict=True):
            part = (np.array(value) - low) / (high - low)
            rgb = value[6:] if old else part[6:]
            quat, opacity, shN = row[1], row[3], row[5]
            largest = max(range(4), key=lambda k: abs(quat[k]))
            rotation = largest
            for k in set(range(4)) - {largest}:
                q = math.copysign(1, quat[largest]) * quat[k]
                rotation = rotation << 10 | level(1023 * (q / math.sqrt(2) + 0.5), 1023)
            packed = [level(p * m, m) for p, m in zip(part[:6], (2047, 1023, 2047) * 2, strict=True)]
            colour = 0
            for c in (*rgb, opacity):
                colour = colour << 8 | level(255 * c, 255)
            words.append([
                packed[0] << 21 | packed[1] << 11 | packed[2], rotation,
                packed[3] << 21 | packed[4] << 11 | packed[5], colour,
            ])  # fmt: skip
            harmonics += bytes(level((c / 8 + 0.5) * 255, 255) for channel in zip(*shN) for c in channel)
    ends = [f"{end}_{of}{a}" for of in ("", "scale_") for end in ("min", "max") for a in "xyz"]
    ends += [] if old else [f"{end}_{c}" for end in ("min", "max") for c in "rgb"]
    rest = len(harmonics) // len(rows)
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {len(chunks)}"]
    lines += [f"property float {name}" for name in ends] + [f"element vertex {len(rows)}"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    if rest:
        lines += [f"element sh {len(rows)}"] + [f"property uchar f_rest_{i}" for i in range(rest)]
    body = np.array(chunks, "<f4").tobytes() + np.array(words, "<u4").tobytes() + bytes(harmonics)
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + body)
