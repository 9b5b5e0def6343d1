"""Render an object from many cameras over many frames, in a separate Blender process.

This module never imports bpy. It writes a job file, starts ``neuma_lib.data.blender.worker`` and moves the images to
the target folder when all are rendered. The object is a `Surface` (moving mesh of a solid, or grains of sand) or a
`Liquid` (a separate surface per frame).
"""

import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from neuma_lib.data.blender import worker
from neuma_lib.data.blender.libraries import explain_import_error
from neuma_lib.errors import InputError
from neuma_lib.geometry.obstacles import Obstacle
from neuma_lib.io.gltf import linear
from neuma_lib.io.images import write_transforms
from neuma_lib.io.processes import start_child
from neuma_lib.splatting.viewpoints import Views

Progress = Callable[[int, int], None]
OTHER_PYTHON = "NEUMA_BLENDER_PYTHON"  # environment variable with another interpreter that has bpy


@dataclass(frozen=True)
class Surface:
    """A mesh with moving vertices, or moving balls of one size."""

    vertices: np.ndarray  # positions [m], shape (T, n, 3); centres for balls
    faces: np.ndarray  # vertex indices, shape (m, 3); empty for balls
    colors: np.ndarray  # sRGB colours of the vertices in [0, 1], shape (n, 3)
    radius: float = 0.0  # of the balls [m]; 0 for a mesh

    def __len__(self) -> int:
        return len(self.vertices)

    @property
    def points(self) -> np.ndarray:
        """Points that must be in the frame (k, 3) [m]; the frame's margin covers the radius of balls."""
        return self.vertices.reshape(-1, 3)

    def arrays(self) -> dict[str, np.ndarray]:
        """Arrays for the Blender process: concatenated vertices of all frames, and the offset of each frame."""
        frames, count = self.vertices.shape[:2]
        return {
            "vertices": self.points.astype(np.float32),
            "vertex_start": np.arange(frames + 1) * count,
            "faces": self.faces.astype(np.int32),
            "face_start": np.array([0, len(self.faces)]),
            "colors": linear(self.colors).astype(np.float32),
            "radius": np.array(float(self.radius)),
        }


@dataclass(frozen=True)
class Liquid:
    """A separate surface per frame: tuples of vertices (n, 3) [m], faces (m, 3), sRGB colours (n, 3)."""

    surfaces: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]

    def __len__(self) -> int:
        return len(self.surfaces)

    @property
    def points(self) -> np.ndarray:
        """Points that must be in the frame (k, 3) [m]."""
        return np.concatenate([vertices for vertices, _, _ in self.surfaces])

    def arrays(self) -> dict[str, np.ndarray]:
        """Arrays as for `Surface`, with faces and colours of every frame."""
        _, faces, colors = (np.concatenate(parts) for parts in zip(*self.surfaces, strict=True))
        return {
            "vertices": self.points.astype(np.float32),
            "vertex_start": np.cumsum([0, *(len(vertices) for vertices, _, _ in self.surfaces)]),
            "faces": faces.astype(np.int32),
            "face_start": np.cumsum([0, *(len(faces) for _, faces, _ in self.surfaces)]),
            "colors": linear(colors).astype(np.float32),
            "radius": np.array(0.0),
        }


@dataclass(frozen=True)
class Several:
    """Several objects with the same number of frames."""

    bodies: Sequence[Surface | Liquid]

    def __len__(self) -> int:
        return len(self.bodies[0])

    @property
    def points(self) -> np.ndarray:
        """Points that must be in the frame (k, 3) [m]."""
        return np.concatenate([body.points for body in self.bodies])

    def arrays(self) -> dict[str, np.ndarray]:
        """Arrays as for `Surface` of each body, whose names begin with its number."""
        named = {
            f"{k}_{name}": value
            for k, body in enumerate(self.bodies)
            for name, value in body.arrays().items()
        }
        return {"bodies": np.array(len(self.bodies)), **named}


LABELS = "labels"  # folder of the label images, in that of the images


def render_images(
    geometry: Surface | Liquid | Several,
    views: Views,
    shots: Sequence[tuple[int, int]],
    out_dir: str | Path,
    names: Sequence[str],
    samples: int,
    threads: int = 1,
    progress: Progress | None = None,
    device: str = "cpu",
    obstacles: Sequence[Obstacle] = (),
    matte: bool = True,
) -> None:
    """Render shots to RGBA PNG files.

    Args:
        geometry: the object, or several, frames 0 ... len - 1. With several and ``matte``, images of the same names in
            the folder `LABELS` have the number of the visible object, from 1, or 0 where they cover less than half.
        shots: (frame, camera) of each image; shots of one frame should be consecutive.
        out_dir: folder of the images, created if missing; existing images are replaced.
        samples: samples per pixel, denoised (except alpha: 8 are usable, 16 clean).
        threads: CPU cores for Blender.
        progress: called with the numbers of finished and of all images.
        device: "cpu", "cuda", or "auto", CUDA if Blender has a device and machine code for it.
        obstacles: other objects, with a pose for each frame.
        matte: alpha is the mask of the visible part of the object. Obstacles and white surroundings are in the colours,
            where alpha is 0. Otherwise alpha is the mask of everything.

    Raises:
        InputError: Blender cannot be imported (the message names the package to install), or CUDA is requested and
            Blender has no CUDA device or no machine code for it.
        RuntimeError: Blender failed; the message ends with its last output.
    """
    out_dir = Path(out_dir)
    out_dir.mkdir(parents=True, exist_ok=True)
    for abandoned in out_dir.glob(".render-*"):  # from a killed process
        shutil.rmtree(abandoned)
    with tempfile.TemporaryDirectory(prefix=".render-", dir=out_dir) as folder:
        job, content = Path(folder) / "job.npz", io.BytesIO()  # savez leaves a file open on a full disk
        np.savez(
            content,
            **geometry.arrays(),
            c2w=views.c2w,
            focal=views.focal,
            size=np.array([views.width, views.height]),
            shots=np.asarray(shots, dtype=np.int64).reshape(-1, 2),
            samples=samples,
            threads=threads,
            device=device,
            matte=matte,
            **obstacle_arrays(obstacles),
        )
        job.write_bytes(content.getbuffer())
        run_worker(worker.__name__, job, len(shots), progress)
        for index, name in enumerate(names):
            image = Path(folder) / f"{index:05d}.png"
            if obstacles and matte:
                _add_surroundings(image, image.with_stem(f"{image.stem}_all"))
            if isinstance(geometry, Several) and matte:
                (out_dir / LABELS).mkdir(exist_ok=True)
                masks = [image.with_stem(f"{image.stem}_body{k}") for k in range(len(geometry.bodies))]
                Image.fromarray(_labels(masks)).save(out_dir / LABELS / name)
            image.write_bytes(_pixels_only(image.read_bytes()))
            os.replace(image, out_dir / name)


def obstacle_arrays(obstacles: Sequence[Obstacle]) -> dict[str, np.ndarray]:
    """Arrays of obstacles for the Blender process."""
    arrays = {
        "obstacle_poses": np.array([each.poses for each in obstacles]),
        "obstacle_colors": np.array([(*linear(each.color), each.opacity) for each in obstacles]),
    }
    for k, each in enumerate(obstacles):
        arrays |= {f"obstacle_{k}_vertices": each.vertices, f"obstacle_{k}_faces": each.faces}
    return arrays


def _labels(masks: Sequence[Path]) -> np.ndarray:
    """Number (h, w) of the object that covers each pixel most, from 1, or 0 where all together cover less than half."""
    alpha = np.stack([np.array(Image.open(mask).convert("RGBA"))[..., 3] for mask in masks]).astype(int)
    return np.where(alpha.sum(axis=0) > 127, 1 + alpha.argmax(axis=0), 0).astype(np.uint8)


def _add_surroundings(image: Path, whole: Path) -> None:
    """Give the pixels of a matte that are transparent the colours of a picture with obstacles, over white."""
    pixels, others = (np.array(Image.open(path).convert("RGBA")) for path in (image, whole))
    share = others[..., 3:] / 255
    behind = (others[..., :3] * share + 255 * (1 - share)).round().astype(np.uint8)
    pixels[..., :3] = np.where(pixels[..., 3:] > 0, pixels[..., :3], behind)
    Image.fromarray(pixels).save(image)


def _pixels_only(png: bytes) -> bytes:
    """A PNG file without text chunks, in which Cycles stores render times, so that equal images have equal bytes."""
    kept, position = [png[:8]], 8
    while position < len(png):
        length = int.from_bytes(png[position : position + 4], "big")
        chunk = png[position : position + length + 12]
        if chunk[4:8] in (b"IHDR", b"IDAT", b"IEND"):
            kept.append(chunk)
        position += length + 12
    return b"".join(kept)


def run_worker(module: str, job: Path, total: int = 0, progress: Progress | None = None) -> None:
    """Run a module of this package in a Blender process on a job file.

    Raises:
        InputError, RuntimeError: see `render_images`.
    """
    root = str(Path(__file__).resolve().parents[3])
    python, packages = sys.executable, [root, os.environ.get("PYTHONPATH", "")]
    if other := os.environ.get(OTHER_PYTHON):
        python, packages = shutil.which(other), [root]  # PYTHONPATH is that of this interpreter
        if python is None:
            raise InputError(f"{OTHER_PYTHON}={other}", "no such program", "Use a Python 3.11 with bpy")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(packages)}
    log = job.with_suffix(".log")
    with open(log, "wb") as sink:
        process = start_child(
            [python, "-m", module, str(job)], stdout=subprocess.PIPE, stderr=sink, env=environment, text=True
        )
        try:
            for line in process.stdout:
                if progress is not None and line.strip().isdigit():
                    progress(int(line), total)
            process.wait()
        except BaseException:
            process.kill()
            process.wait()
            raise
    if process.returncode:
        output = log.read_text(errors="replace")
        if error := explain_import_error(output):
            raise error
        pattern = rf"^{re.escape(InputError.__module__)}\.InputError: (.+?): (.+)"
        if raised := re.search(pattern, output, re.MULTILINE):
            raise InputError(*raised.groups())
        tail = "\n".join(output.strip().splitlines()[-12:])
        raise RuntimeError(f"Blender ended with status {process.returncode}:\n{tail}")


def render_static(
    geometry: Surface | Liquid | Several, views: Views, out_dir: str | Path, samples: int, **options: Any
) -> None:
    """Render frame 0 from every camera to ``s_<view>.png``, and write transforms.json of those that see the object.

    ``options`` are those of `render_images`.
    """
    shots = [(0, view) for view in range(len(views))]
    names = [f"s_{view:03d}.png" for _, view in shots]
    _render_set(geometry, views, shots, names, [0], [0.0], out_dir, samples, **options)


def render_dynamic(
    geometry: Surface | Liquid | Several,
    views: Views,
    steps: Sequence[int],
    dt: float,
    out_dir: str | Path,
    samples: int,
    **options: Any,
) -> None:
    """Render every frame from every camera to ``d_<view>_<step>.png``, and write transforms.json.

    Frames in which an obstacle hides the object are not listed.

    Args:
        steps: simulation step of each frame of ``geometry``.
        dt: time step [s].
        options: those of `render_images`.
    """
    if len(steps) != len(geometry):
        raise InputError("steps", f"there are {len(steps)} steps for {len(geometry)} frames of geometry")
    shots = [(frame, view) for frame in range(len(geometry)) for view in range(len(views))]
    names = [f"d_{view}_{steps[frame]:04d}.png" for frame, view in shots]
    times = [float(step) * dt for step in steps]
    _render_set(geometry, views, shots, names, steps, times, out_dir, samples, **options)


def _render_set(geometry, views, shots, names, steps, times, out_dir, samples, **options) -> None:
    transforms = Path(out_dir, "transforms.json")
    transforms.unlink(missing_ok=True)  # marks the folder as unfinished
    render_images(geometry, views, shots, out_dir, names, samples, **options)
    masks = (
        np.asarray(Image.open(Path(out_dir, name)))[..., 3] for name in names if options.get("obstacles")
    )
    visible = [bool((mask > 127).any()) for mask in masks] or [True] * len(names)
    if not any(visible):
        raise InputError("colliders", "hide the body in all images", "Move them, or give the scene images")
    frames = [
        {
            "file_path": name,
            "transform_matrix": views.c2w[view].tolist(),
            "view": int(view),
            "step": int(steps[frame]),
            "time": round(times[frame], 9),
        }
        for name, (frame, view), seen in zip(names, shots, visible, strict=True)
        if seen
    ]
    if isinstance(geometry, Several):
        for frame in frames:
            frame["label_path"] = f"{LABELS}/{frame['file_path']}"
    lens = {"fl_x": views.focal, "fl_y": views.focal, "cx": views.width / 2, "cy": views.height / 2}
    write_transforms(transforms, {"w": views.width, "h": views.height, **lens}, frames)
