"""Gaussians as PLY in the layout of the 3DGS release."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import torch

from neuma_lib.errors import InputError
from neuma_lib.io.ply import read_ply, write_ply
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.spherical_harmonics import MAX_DEGREE, coefficient_count

REST_COUNTS = [3 * (coefficient_count(degree) - 1) for degree in range(MAX_DEGREE + 1)]
"""Valid numbers of f_rest_* properties: three channels of the degrees above 0."""


def save_gaussians(path: str | Path, gaussians: Gaussians) -> None:
    """Write Gaussians as splat viewers read them: log scales, logits of opacities, SH by channel."""
    arrays = {f.name: getattr(gaussians, f.name).detach().cpu().numpy() for f in fields(gaussians)}
    means, quats, scales, opacities, sh0, shN = arrays.values()
    G, rest = len(means), shN.shape[1] * 3
    opacities = np.clip(np.asarray(opacities, dtype=np.float64), 1e-7, 1 - 1e-7)
    columns = {
        **dict(zip("xyz", np.asarray(means).T, strict=True)),
        **dict.fromkeys(("nx", "ny", "nz"), np.zeros(G)),
        **{f"f_dc_{i}": sh0[:, 0, i] for i in range(3)},
        **{f"f_rest_{i}": c for i, c in enumerate(np.swapaxes(shN, 1, 2).reshape(G, rest).T)},
        "opacity": np.log(opacities / (1 - opacities)),
        **{f"scale_{i}": np.log(scales[:, i]) for i in range(3)},
        **{f"rot_{i}": quats[:, i] for i in range(4)},
    }
    rows = np.empty(G, dtype=[(name, "<f4") for name in columns])
    for name, column in columns.items():
        rows[name] = column
    write_ply(path, rows)


def load_gaussians(path: str | Path, remedy: str = "Fit the Gaussians again") -> Gaussians:
    """Read Gaussians in the 3DGS layout, in float32, with unit quaternions.

    Raises:
        InputError: missing properties, or values that are not finite, with the given ``remedy``.
    """
    rows, _ = read_ply(path)
    names = set(rows.dtype.names)
    rest = sum(name.startswith("f_rest_") for name in names)
    groups = {
        "means": ["x", "y", "z"],
        "sh0": [f"f_dc_{i}" for i in range(3)],
        "opacities": ["opacity"],
        "scales": [f"scale_{i}" for i in range(3)],
        "quats": [f"rot_{i}" for i in range(4)],
        "shN": [f"f_rest_{i}" for i in range(rest)],
    }
    if missing := [name for group in groups.values() for name in group if name not in names]:
        problem = f"is not a 3D Gaussian splatting file: it has no property {', '.join(missing)}"
        raise InputError(path, problem)
    if rest not in REST_COUNTS:
        raise InputError(path, f"has {rest} f_rest_* properties, expected one of {REST_COUNTS}")
    raw = {}
    for key, columns in groups.items():
        raw[key] = np.zeros((len(rows), len(columns)), np.float32)
        for i, column in enumerate(columns):
            raw[key][:, i] = rows[column]
        # converters from layouts with 8-bit opacities write 0 and 1 as infinite logits
        usable = ~np.isnan(raw[key]) if key == "opacities" else np.isfinite(raw[key])
        if (bad := ~usable.all(axis=1)).any():
            raise InputError(path, f"{key} of Gaussian {np.argmax(bad)} is not finite", remedy)
    norm = np.linalg.norm(raw["quats"], axis=1, keepdims=True)
    if (norm == 0).any():
        raise InputError(path, f"the rotation of Gaussian {np.argmin(norm)} is zero", remedy)
    arrays = {
        "means": raw["means"],
        "quats": raw["quats"] / norm,
        "scales": np.exp(raw["scales"]),
        "opacities": (1 / (1 + np.exp(-raw["opacities"][:, 0].astype(np.float64)))).astype(np.float32),
        "sh0": raw["sh0"][:, None, :],
        "shN": np.ascontiguousarray(np.swapaxes(raw["shN"].reshape(len(rows), 3, rest // 3), 1, 2)),
    }
    return Gaussians(**{name: torch.from_numpy(array) for name, array in arrays.items()})
