"""A moving surface as a .blend file, written by a separate Blender process."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from neuma_lib.data.blender.scene import obstacle_arrays, run_worker
from neuma_lib.geometry.obstacles import Obstacle
from neuma_lib.io.files import atomic
from neuma_lib.io.gltf import linear
from neuma_lib.splatting.viewpoints import video_views

_WORKER = "neuma_lib.data.blender.cycles_animation"
_SIZE, _SAMPLES = (256, 256), 16  # size of the preview [px], and samples per pixel


def write_blend(
    path: str | Path,
    picture: str | Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    times: np.ndarray,
    colors: np.ndarray,
    obstacles: Sequence[Obstacle] = (),
) -> None:
    """Write a moving surface, and a render of its last frame from the front; other arguments as for `write_glb`.

    In the file z is up, as in Blender. The object is rotated; its vertices have the coordinates of the simulator.

    Raises:
        InputError: Blender cannot be imported.
        RuntimeError: Blender failed; the message ends with its last output.
    """
    views = video_views(np.asarray(vertices).reshape(-1, 3), 1, *_SIZE)
    with tempfile.TemporaryDirectory(prefix="neuma-blend-") as folder:
        job = Path(folder) / "job.npz"
        np.savez(
            job, vertices=np.asarray(vertices, np.float32), faces=np.asarray(faces, np.int32), times=times,
            colors=linear(colors).astype(np.float32), pose=views.c2w[0], focal=views.focal, size=np.array(_SIZE),
            samples=_SAMPLES, threads=1, preview_time=times[-1], **obstacle_arrays(obstacles),
        )  # fmt: skip
        run_worker(_WORKER, job)
        for source, target in ((job.with_name("motion.blend"), path), (job.with_name("proof.png"), picture)):
            with atomic(target) as partial:
                partial.write_bytes(source.read_bytes())
