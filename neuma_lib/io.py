"""One reader and one writer for every artifact.

Writers are atomic (a temporary name in the same folder, then a rename) and deterministic: the same arrays give the
same bytes, without dates, host names or paths. Readers check what they read; a damaged or foreign file is an
`InputError` that names the file, what is wrong with it and what to do.

Lengths are metres, times seconds, masses kilograms; arrays are numpy.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.ply import read_ply, write_ply
from neuma_lib.released import released_frames

QUANTITIES = {
    "x": ("m", "particle positions, shape (T, N, 3), or (N, 3) where there is one state"),
    "v": ("m/s", "particle velocities, shape (T, N, 3)"),
    "F": ("1", "elastic deformation gradients, shape (T, N, 3, 3)"),
    "F_total": ("1", "total deformation gradients, plastic flow included, shape (T, N, 3, 3)"),
    "C": ("1/s", "APIC affine velocities, shape (T, N, 3, 3)"),
    "frames": ("1", "simulation step of each frame, shape (T,)"),
    "time": ("s", "time of each frame, shape (T,)"),
    "vol0": ("m^3", "initial particle volumes, shape (N,)"),
    "mass": ("kg", "particle masses, shape (N,)"),
    "tracers": ("m", "positions of passive tracers, shape (T, M, 3)"),
    "tracers_again": ("m", "passive tracers of another sampling of the same body, shape (T, M, 3)"),
    "indptr": ("1", "row starts of a sparse matrix, shape (rows + 1,)"),
    "indices": ("1", "columns of a sparse matrix, shape (entries,)"),
    "values": ("1", "entries of a sparse matrix, shape (entries,)"),
    "images": ("1", "pictures of a figure, colours 0 to 255, shape (rows, columns, H, W, 3)"),
}


# ------------------------------------------------------------------------------------------------- writing safely


@contextmanager
def atomic(path: str | Path) -> Iterator[Path]:
    """A temporary path in the folder of ``path``; it takes the final name when the block ends without an error.

    A killed process leaves at most one file named ``.partial-<name>``, which the next run overwrites.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{path.name}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text."""
    with atomic(path) as partial:
        partial.write_bytes(text.encode())


def write_json(path: str | Path, data: Any) -> None:
    """Write JSON with keys in the given order. Raises ValueError on NaN or infinity."""
    write_text(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def read_json(path: str | Path) -> Any:
    """Read JSON. Raises InputError when the file is missing or is not JSON."""
    try:
        return json.loads(_existing(path).read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path} is not valid JSON ({error}): delete it and run the workflow again"
        ) from None


def _existing(path: str | Path) -> Path:
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path} does not exist: run the stage that makes it, or correct the path")
    return path


# -------------------------------------------------------------------------------------------------------- HDF5


def write_arrays(
    path: str | Path, arrays: Mapping[str, Any], attributes: Mapping[str, Any] | None = None
) -> None:
    """Write named quantities (see `QUANTITIES`) to HDF5, each with its unit, and file attributes.

    Args:
        arrays: quantity name -> array; None entries are left out.
        attributes: numbers and texts; anything else is stored as JSON text.
    """
    import h5py

    with atomic(path) as partial, h5py.File(partial, "w", track_order=True) as file:
        for name, array in arrays.items():
            if array is None:
                continue
            unit, description = QUANTITIES[name]
            data = file.create_dataset(name, data=np.asarray(array), track_times=False)
            data.attrs["unit"] = unit
            data.attrs["description"] = description
        for key, value in (attributes or {}).items():
            file.attrs[key] = value if isinstance(value, str | int | float) else json.dumps(value)


def read_arrays(
    path: str | Path, required: Sequence[str] = (), only: Sequence[str] | None = None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read quantities and attributes of an HDF5 artifact.

    Args:
        required: names that must be there.
        only: names to read (others stay on disk); None reads everything.

    Raises:
        InputError: missing or damaged file, missing quantity, or a value that is not finite.
    """
    import h5py

    path = _existing(path)
    try:
        with h5py.File(path, "r") as file:
            missing = [name for name in required if name not in file]
            if missing:
                raise InputError(f"{path} has no dataset {', '.join(missing)} (it has {', '.join(file)})")
            arrays = {name: file[name][()] for name in file if only is None or name in only}
            attributes = dict(file.attrs.items())
    except OSError as error:
        raise InputError(
            f"{path} cannot be read as HDF5 ({error}): delete it and run the workflow again"
        ) from None
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InputError(f"{path}: dataset {name} holds values that are not finite: make the file again")
    return arrays, {k: v.item() if isinstance(v, np.generic) else v for k, v in attributes.items()}


# -------------------------------------------------------------------------------------------- images and cameras


@dataclass(frozen=True)
class ImageSet:
    """Calibrated images: one entry a file, in the order of transforms.json.

    Attributes:
        images: straight-alpha RGBA, uint8, shape (K, H, W, 4).
        viewmats: world to camera, OpenCV axes, shape (K, 4, 4).
        Ks: intrinsics [px], pixel centres at +0.5, shape (K, 3, 3).
        views: camera number of each image, shape (K,).
        steps: simulation step of each image, shape (K,).
        names: file names.
    """

    images: np.ndarray
    viewmats: np.ndarray
    Ks: np.ndarray
    views: np.ndarray
    steps: np.ndarray
    names: tuple[str, ...]

    @property
    def width(self) -> int:
        return self.images.shape[2]

    @property
    def height(self) -> int:
        return self.images.shape[1]

    def video(self, views: Sequence[int]) -> tuple[tuple[int, ...], np.ndarray, np.ndarray]:
        """Frames of some views: steps, indices into the images of shape (T, V), and camera indices of shape (V,).

        Raises:
            InputError: a view is missing, or the views were not filmed at the same steps.
        """
        columns = []
        for view in views:
            chosen = np.flatnonzero(self.views == view)
            if len(chosen) == 0:
                raise InputError(
                    f"view {view} is not among the filmed views {sorted(set(self.views.tolist()))}"
                )
            columns.append(chosen[np.argsort(self.steps[chosen], kind="stable")])
        steps = [tuple(self.steps[c].tolist()) for c in columns]
        if any(s != steps[0] for s in steps):
            raise InputError(f"views {list(views)} were not filmed at the same steps")
        index = np.stack(columns, axis=1)
        return steps[0], index, index[0]


OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def write_transforms(
    path: str | Path, intrinsics: Mapping[str, float], frames: Sequence[Mapping[str, Any]], **extra: Any
) -> None:
    """Write transforms.json beside images that exist already; the sha256 of each image is added.

    Args:
        path: .../transforms.json.
        intrinsics: fl_x, fl_y, cx, cy [px], w, h.
        frames: dicts with ``file_path`` relative to the folder, ``transform_matrix`` (camera to world, OpenGL
            axes, 4 x 4) and what else is known of a frame (``view``, ``step``, ``time``).
        extra: further top-level entries.
    """
    folder = Path(path).parent
    entries = [{**frame, "sha256": sha256_file(folder / frame["file_path"])} for frame in frames]
    write_json(path, {**intrinsics, **extra, "frames": entries})


def list_images(source: str | Path, path: str | Path) -> ImageSet:
    """Write a transforms.json for images that stay where another list names them; returns what it lists.

    Args:
        source: a transforms.json, or a list in the layout of the authors' release.
        path: the new transforms.json.

    Raises:
        InputError: as of `read_image_set`.
    """
    images = read_image_set(source)
    data = read_transforms(source)
    files = [_image_file(Path(source).parent, frame["file_path"], source) for frame in data["frames"]]
    folder = Path(path).parent
    folder.mkdir(parents=True, exist_ok=True)
    places = [os.path.relpath(file.resolve(), folder.resolve()) for file in files]
    frames = [{**f, "file_path": place} for f, place in zip(data.pop("frames"), places, strict=True)]
    write_transforms(path, data, frames)
    return images


def read_transforms(path: str | Path) -> dict[str, Any]:
    """Read and check transforms.json: for every frame a file, a pose, and intrinsics (its own or the file's).

    A list in the layout of the authors' release is read as well (`neuma_lib.released`).

    Raises:
        InputError: names the file, the frame and the missing or wrong entry.
    """
    data = read_json(path)
    if isinstance(data, list):
        data = {"frames": released_frames(data, path)}
    if not isinstance(data, dict) or not data.get("frames"):
        raise InputError(f"{path}: the list 'frames' is missing or empty")
    for i, frame in enumerate(data["frames"]):
        if "file_path" not in frame:
            raise InputError(f"{path}: frame {i} has no file_path")
        _check_intrinsics({**data, **frame}, f"{path}: frame {i} ({frame['file_path']})")
        matrix = np.asarray(frame.get("transform_matrix", ()), dtype=object)
        if matrix.shape != (4, 4):
            raise InputError(
                f"{path}: frame {i} ({frame['file_path']}) needs a 4x4 transform_matrix (camera to world)"
            )
        matrix = matrix.astype(np.float64)
        rotation = matrix[:3, :3]
        if not np.isfinite(matrix).all() or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
            raise InputError(
                f"{path}: the transform_matrix of frame {i} ({frame['file_path']}) is not a rigid motion"
            )
    return data


def _check_intrinsics(values: Mapping[str, Any], where: str) -> None:
    if "fl_x" not in values and "camera_angle_x" not in values:
        raise InputError(
            f"{where} has no intrinsics: give fl_x, fl_y, cx, cy in pixels, or camera_angle_x in radians"
        )
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x"):
        value = values.get(key, 1)
        if not (isinstance(value, int | float) and math.isfinite(value) and value > 0):
            raise InputError(f"{where}: {key} must be a positive number, not {value!r}")


def _intrinsic_matrix(values: Mapping[str, Any], width: int, height: int) -> np.ndarray:
    focal = values["fl_x"] if "fl_x" in values else 0.5 * width / math.tan(0.5 * values["camera_angle_x"])
    cx, cy = values.get("cx", width / 2), values.get("cy", height / 2)
    return np.array([[focal, 0, cx], [0, values.get("fl_y", focal), cy], [0, 0, 1]], dtype=np.float64)


def read_image_set(path: str | Path, views: Sequence[int] | None = None) -> ImageSet:
    """Read the images that a transforms.json lists, verifying their checksums where it holds them.

    Args:
        path: .../transforms.json.
        views: read the images of these views only; None reads all.

    Raises:
        InputError: missing image, truncated or changed image, image of another size, no intrinsics, empty mask.
    """
    data = read_transforms(path)
    folder = Path(path).parent
    chosen = [
        (i, frame)
        for i, frame in enumerate(data["frames"])
        if views is None or int(frame.get("view", i)) in views
    ]
    if not chosen:
        raise InputError(f"{path}: no frame belongs to the views {list(views or ())}")
    images = _read_all(
        [(_image_file(folder, frame["file_path"], path), frame.get("sha256")) for _, frame in chosen]
    )
    height, width = images.shape[1:3]
    merged = [{**data, **frame} for _, frame in chosen]
    for values in merged:
        if (int(values.get("w", width)), int(values.get("h", height))) != (width, height):
            raise InputError(
                f"{path}: w, h of {values['file_path']} are {values['w']}x{values['h']}, the image is {width}x{height}:"
                " correct the intrinsics"
            )
    poses = np.array([frame["transform_matrix"] for _, frame in chosen], dtype=np.float64)
    return ImageSet(
        images=images,
        viewmats=np.linalg.inv(poses @ OPENGL_TO_OPENCV),
        Ks=np.stack([_intrinsic_matrix(values, width, height) for values in merged]),
        views=np.array([int(frame.get("view", i)) for i, frame in chosen]),
        steps=np.array([int(frame.get("step", 0)) for _, frame in chosen]),
        names=tuple(frame["file_path"] for _, frame in chosen),
    )


def _image_file(folder: Path, name: str, listed_in: str | Path) -> Path:
    for candidate in (folder / name, folder / f"{name}.png"):
        if candidate.is_file():
            return candidate
    raise InputError(
        f"{folder / name} is missing although {listed_in} lists it: remove the frame from the list, or render it again"
        f" with `snakemake --cores 2 --forcerun render_static render_dynamic`"
    )


def _read_all(files: Sequence[tuple[Path, str | None]]) -> np.ndarray:
    """Images of one size (K, H, W, 4), on all cores: decoding and checksums run outside Python's lock."""
    first = _read_rgba(*files[0])
    images = np.empty((len(files), *first.shape), dtype=np.uint8)
    images[0] = first

    def read(row: int) -> None:
        image = _read_rgba(*files[row])
        if image.shape != first.shape:
            sizes = (f"{i.shape[1]}x{i.shape[0]}" for i in (image, first))
            raise InputError("{} is {}, others {}".format(files[row][0], *sizes))
        images[row] = image

    with ThreadPoolExecutor() as pool:
        for _ in pool.map(read, range(1, len(files))):
            pass
    return images


def _read_rgba(path: Path, sha256: str | None) -> np.ndarray:
    from PIL import Image

    if sha256 is not None and sha256_file(path) != sha256:
        raise InputError(
            f"{path} is damaged or was changed: its sha256 differs from the one in transforms.json; render it again"
        )
    try:
        with Image.open(path) as image:
            image.load()
            if image.mode in ("I;16", "I"):
                raise InputError(f"{path} has 16 bits a channel: convert it to 8-bit RGBA")
            has_alpha = "A" in image.mode or "transparency" in image.info
            pixels = np.asarray(image.convert("RGBA"))
    except (OSError, SyntaxError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is not a readable image, perhaps truncated ({error}): replace it") from None
    if not has_alpha:
        raise InputError(f"{path} has no alpha channel: the object's mask must be stored as alpha (RGBA)")
    if not (pixels[..., 3] > 127).any():
        raise InputError(
            f"{path}: the mask (alpha) is empty, the object is not in the picture: remove this frame"
        )
    return pixels


def sha256_file(path: str | Path) -> str:
    """Hex digest of a file's bytes."""
    return hashlib.sha256(_existing(path).read_bytes()).hexdigest()


# ------------------------------------------------------------------------------------------------------- meshes


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


# ---------------------------------------------------------------------------------------------------- Gaussians


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


# ------------------------------------------------------------------------------------------------------ weights


def write_weights(path: str | Path, tensors: Mapping[str, Any], metadata: Mapping[str, Any]) -> None:
    """Write torch tensors to safetensors, with metadata as one JSON text (their own header has no fixed order)."""
    from safetensors.torch import save_file

    kept = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with atomic(path) as partial:
        save_file(kept, partial, metadata={"neuma": json.dumps(metadata, sort_keys=True)})


def read_weights(path: str | Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read torch tensors and metadata from safetensors.

    Raises:
        InputError: missing, truncated or foreign file, or weights that are not finite.
    """
    from safetensors import SafetensorError, safe_open

    path = _existing(path)
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            metadata = json.loads((file.metadata() or {}).get("neuma", "{}"))
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is not a readable safetensors file ({error}): make it again") from None
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise InputError(f"{path}: {name} is not finite: train again")
    return tensors, metadata
