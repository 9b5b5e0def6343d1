"""Render images of a room with a moving body, in a separate Blender process (`room_worker`)."""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neuma_lib.data.blender.scene import Progress, run_worker
from neuma_lib.io.gltf import linear
from studies.capture_benchmark import room_worker


@dataclass(frozen=True, eq=False)
class Scenery:
    """The static scene.

    Attributes:
        corners: left upper, right upper, right lower and left lower corner of each rectangle's texture [m], (R, 4, 3).
        pictures: texture of each rectangle, sRGB (H, W, 3), uint8.
        lamps: centres of circular lamps [m], (L, 3).
        lamp_size: diameter of the lamps [m].
        lamp_target: point that the lamps face [m], (3,).
        power: of each lamp [W].
        ambient: radiance outside the rectangles.
        bounces: maximum number of light bounces.
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
    """An image or a region of it.

    Attributes:
        c2w: camera to world (4, 4), OpenGL axes.
        lens: width, height, width and height of the larger image centred at the optical axis, left and top in it [px],
            and the coefficients k0 to k4 of the polynomial from distance to angle [rad / px^n], (11,).
        frame: of the body; -1: without it.
        region: x0, y0, x1, y1 [px]; None: the whole image.
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
    row_time: float = 0.0,
    threads: int = 1,
    progress: Progress | None = None,
) -> Iterator[np.ndarray]:
    """Render shots and yield the linear radiance (H, W, 3), float32, of each, after all are rendered.

    Args:
        body: None if no shot shows it.
        shots: those of one frame of the body should be consecutive.
        samples: samples per pixel, denoised.
        exposure: exposure time [s] centred at the frame, with linear motion; 0: no motion blur.
        row_time: of a rolling shutter from the top [s]; the time of a frame is that of the optical axis.
        threads: CPU cores for Blender.

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
            colors=linear(body.colors).astype(np.float32),
            radius=np.array(0.0),
            velocities=body.velocities.astype(np.float32),
            lenses=lenses,
            shots=np.stack([numbers.ravel(), [shot.frame for shot in shots]], axis=1),
            c2w=np.stack([shot.c2w for shot in shots]),
            regions=np.array(regions, np.int64),
            samples=samples,
            exposure=exposure,
            row_time=row_time,
            threads=threads,
        )
        run_worker(room_worker.__name__, job, len(shots), progress)
        for number in range(len(shots)):
            yield np.load(Path(folder) / f"{number:05d}.npy").astype(np.float32)
