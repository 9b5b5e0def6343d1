"""Surfaces and Gaussians as PLY."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.io.files import _existing, atomic
from neuma_lib.io.ply_container import read_ply, write_ply


def write_mesh(
    path: str | Path, vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray | None = None
) -> None:
    """Write a triangle mesh: vertices (N, 3) [m], faces (M, 3), optional colours (N, 3) in [0, 255]."""
    kind = [(axis, "<f4") for axis in "xyz"] + (
        [(c, "u1") for c in ("red", "green", "blue")] if colors is not None else []
    )
    rows = np.empty(len(vertices), dtype=kind)
    for i, axis in enumerate("xyz"):
        rows[axis] = vertices[:, i]
    if colors is not None:
        for i, channel in enumerate(("red", "green", "blue")):
            rows[channel] = colors[:, i]
    with atomic(path) as partial:
        write_ply(partial, rows, faces)


def read_mesh(path: str | Path, watertight: bool = True) -> Any:
    """Read a triangle mesh as `trimesh.Trimesh` in metres.

    Raises:
        InputError: missing properties, values that are not finite, or holes where ``watertight`` is asked for.
    """
    import trimesh

    rows, faces = read_ply(_existing(path))
    missing = [axis for axis in "xyz" if axis not in rows.dtype.names]
    if missing or faces is None or len(faces) == 0:
        raise InputError(
            f"{path} is not a triangle mesh: {'no faces' if not missing else 'no ' + ', '.join(missing)}"
        )
    vertices = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        raise InputError(
            f"{path}: vertex {int(np.argmax(bad))} of {len(bad)} is not finite: repair or rebuild the mesh"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(f"{path}: a face names a vertex that does not exist: rebuild the mesh")
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if watertight and not mesh.is_watertight:
        raise InputError(
            f"{path} is not watertight, so it has no inside: close its holes (a mesh repair tool) first"
        )
    if watertight and mesh.volume <= 0:
        raise InputError(f"{path} has a volume of {mesh.volume:.3g} m^3: its faces point inwards, flip them")
    return mesh


def write_gaussians(
    path: str | Path,
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    sh0: np.ndarray,
    shN: np.ndarray,
) -> None:
    """Write Gaussians in the layout of the 3DGS release, which every splat viewer opens.

    Args:
        means: (G, 3) [m].
        quats: (G, 4), w x y z.
        scales: (G, 3) standard deviations [m] (stored as logarithms).
        opacities: (G,) in (0, 1) (stored as logits).
        sh0: (G, 1, 3). shN: (G, K - 1, 3), stored channel by channel.
    """
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
    with atomic(path) as partial:
        write_ply(partial, rows)


def read_gaussians(path: str | Path) -> dict[str, np.ndarray]:
    """Read Gaussians in the 3DGS layout: float32 means, quats (unit), scales, opacities, sh0, shN (see the writer).

    Raises:
        InputError: missing properties (they are listed), or values that are not finite.
    """
    rows, _ = read_ply(_existing(path))
    names = set(rows.dtype.names)
    groups = {
        "means": ["x", "y", "z"],
        "sh0": [f"f_dc_{i}" for i in range(3)],
        "opacities": ["opacity"],
        "scales": [f"scale_{i}" for i in range(3)],
        "quats": [f"rot_{i}" for i in range(4)],
    }
    missing = [name for group in groups.values() for name in group if name not in names]
    if missing:
        raise InputError(
            f"{path} misses the properties {', '.join(missing)}: it is not a 3D Gaussian splatting file"
        )
    rest = sum(name.startswith("f_rest_") for name in names)
    bands = rest // 3 + 1
    if rest % 3 or math.isqrt(bands) ** 2 != bands or any(f"f_rest_{i}" not in names for i in range(rest)):
        raise InputError(
            f"{path}: {rest} f_rest_* properties are not a whole number of SH degrees (9, 24 or 45)"
        )

    def stack(columns):
        if not columns:
            return np.zeros((len(rows), 0), np.float32)
        return np.stack([rows[c] for c in columns], axis=1).astype(np.float32)

    raw = {key: stack(columns) for key, columns in groups.items()}
    raw["shN"] = stack([f"f_rest_{i}" for i in range(rest)])
    for key, array in raw.items():
        bad = ~np.isfinite(array).all(axis=1)
        if bad.any():
            raise InputError(
                f"{path}: {key} of Gaussian {int(np.argmax(bad))} is not finite: fit the Gaussians again"
            )
    norm = np.linalg.norm(raw["quats"], axis=1, keepdims=True)
    if (norm == 0).any():
        raise InputError(
            f"{path}: the rotation of Gaussian {int(np.argmin(norm))} is zero: fit the Gaussians again"
        )
    return {
        "means": raw["means"],
        "quats": raw["quats"] / norm,
        "scales": np.exp(raw["scales"]),
        "opacities": (1 / (1 + np.exp(-raw["opacities"][:, 0].astype(np.float64)))).astype(np.float32),
        "sh0": raw["sh0"][:, None, :],
        "shN": np.ascontiguousarray(np.swapaxes(raw["shN"].reshape(len(rows), 3, rest // 3), 1, 2)),
    }
