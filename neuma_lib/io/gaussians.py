"""Gaussians as PLY in the layout of the 3DGS release."""

from collections.abc import Mapping
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
        InputError: missing properties, or see `checked_gaussians`.
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
    with np.errstate(
        over="ignore"
    ):  # layouts with 8-bit opacities are converted to infinite logits of 0 and 1
        arrays = {
            "means": raw["means"],
            "quats": raw["quats"],
            "scales": np.exp(raw["scales"]),
            "opacities": 1 / (1 + np.exp(-raw["opacities"][:, 0].astype(np.float64))),
            "sh0": raw["sh0"][:, None, :],
            "shN": np.swapaxes(raw["shN"].reshape(len(rows), 3, rest // 3), 1, 2),
        }
    return checked_gaussians(arrays, path, remedy)


def checked_gaussians(arrays: Mapping[str, np.ndarray], path: str | Path, remedy: str) -> Gaussians:
    """Gaussians in float32 from arrays by name, with normalised quaternions.

    Raises:
        InputError: no Gaussians; or names one with values that are not finite, a scale that is not positive, or a
            rotation of zero.
    """
    if len(arrays["means"]) == 0:
        raise InputError(path, "has no Gaussians")
    norm = np.linalg.norm(arrays["quats"], axis=1, keepdims=True)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        single = {**arrays, "quats": arrays["quats"] / norm}
        single = {name: np.ascontiguousarray(array, np.float32) for name, array in single.items()}
    bad = {
        "the rotation of Gaussian {} is zero": norm[:, 0] == 0,
        **{
            f"{name} of Gaussian {{}} is not finite": ~np.isfinite(array).all(
                axis=tuple(range(1, array.ndim))
            )
            for name, array in single.items()
        },
        "a scale of Gaussian {} is not positive": (single["scales"] <= 0).any(axis=1),
    }
    for problem, rows in bad.items():
        if rows.any():
            raise InputError(path, problem.format(np.argmax(rows)), remedy)
    return Gaussians(**{name: torch.from_numpy(array) for name, array in single.items()})
