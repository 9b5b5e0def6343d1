"""Film a room with one moving body in it, in a Blender process of its own (`room_worker`)."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neuma_lib.data.blender import room_worker
from neuma_lib.data.blender.appearance import to_linear
from neuma_lib.data.blender.scene import Progress, run_worker


@dataclass(frozen=True, eq=False)
class Scenery:
    """What stands still.

    Attributes:
        corners: of each rectangle, those of its picture's left upper, right upper, right lower and left lower corner
            [m], (R, 4, 3).
        pictures: of each rectangle, sRGB (H, W, 3), uint8.
        lamps: middles of round lamps [m], (L, 3).
        lamp_size: their diameter [m].
        lamp_target: what they face [m], (3,).
        power: of each [W].
        ambient: radiance of what is above and beyond all rectangles.
        bounces: of light.
    """

    corners: np.ndarray
    pictures: Sequence[np.ndarray]
    lamps: np.ndarray
    lamp_size: float
    lamp_target: np.ndarray
    power: float
    ambient: float
    bounces: int


@dataclass(frozen=True, eq=False)
class Moving:
    """A mesh in motion.

    Attributes:
        vertices, velocities: [m], [m/s], (T, n, 3).
        faces: (m, 3).
        colors: sRGB in [0, 1], (n, 3).
    """

    vertices: np.ndarray
    velocities: np.ndarray
    faces: np.ndarray
    colors: np.ndarray


@dataclass(frozen=True, eq=False)
class Shot:
    """One picture, or a part of it.

    Attributes:
        c2w: camera to world (4, 4), OpenGL axes.
        lens: width, height, those of the larger picture in whose middle the optical axis is, left and top in it [px],
            and the coefficients k0 to k4 of the polynomial from distance to angle [rad / px^n], (11,).
        frame: of the body; -1: it is not there.
        region: x0, y0, x1, y1 [px]; None: all of the picture.
    """

    c2w: np.ndarray
    lens: np.ndarray
    frame: int
    region: tuple[int, int, int, int] | None = None


def shoot(
    scenery: Scenery,
    body: Moving | None,
    shots: Sequence[Shot],
    *,
    samples: int,
    exposure: float = 0.0,
    threads: int = 1,
    progress: Progress | None = None,
) -> Iterator[np.ndarray]:
    """Render shots: linear radiance (H, W, 3), float32, of each, in turn, once all are there.

    Args:
        body: None where no shot shows it.
        shots: those of one frame of the body should stand together.
        samples: samples a pixel, denoised.
        exposure: how long the body moves while a shot is taken [s], half of it before the frame's time; the motion is
            straight, and 0 stops it.
        threads: CPU cores that Blender may use.

    Raises:
        InputError, RuntimeError: see `neuma_lib.data.blender.scene.render_images`.
    """
    lenses, numbers = np.unique(np.stack([shot.lens for shot in shots]), axis=0, return_inverse=True)
    regions = [shot.region or (0, 0, *shot.lens[:2]) for shot in shots]
    body = body or Moving(np.zeros((0, 0, 3)), np.zeros((0, 0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))
    frames, count = body.vertices.shape[:2]
    with tempfile.TemporaryDirectory(prefix="neuma-room-") as folder:
        job = Path(folder) / "job.npz"
        np.savez(
            job,
            corners=scenery.corners,
            **{f"picture{i}": picture for i, picture in enumerate(scenery.pictures)},
            lamps=scenery.lamps,
            lamp_powers=np.full(len(scenery.lamps), scenery.power),
            lamp_size=scenery.lamp_size,
            lamp_target=scenery.lamp_target,
            ambient=scenery.ambient,
            bounces=scenery.bounces,
            vertices=body.vertices.reshape(-1, 3).astype(np.float32),
            vertex_start=np.arange(frames + 1) * count,
            faces=body.faces.astype(np.int32),
            face_start=np.array([0, len(body.faces)]),
            colors=to_linear(body.colors).astype(np.float32),
            radius=np.array(0.0),
            velocities=body.velocities.astype(np.float32),
            lenses=lenses,
            shots=np.stack([numbers.ravel(), [shot.frame for shot in shots]], axis=1),
            c2w=np.stack([shot.c2w for shot in shots]),
            regions=np.array(regions, np.int64),
            samples=samples,
            exposure=exposure,
            threads=threads,
        )
        run_worker(room_worker.__name__, job, len(shots), progress)
        for number in range(len(shots)):
            yield np.load(Path(folder) / f"{number:05d}.npy").astype(np.float32)
