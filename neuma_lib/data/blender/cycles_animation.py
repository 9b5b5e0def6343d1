"""Write and render a .blend file with a moving surface: ``python -m neuma_lib.data.blender.cycles_animation job.npz``.

The surface has one shape key per frame and an animated evaluation time.
"""

import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from neuma_lib.data.blender import cycles

RATE = 24  # Blender's frames per second


def main(path: str) -> None:
    with np.load(path) as file:
        job = dict(file)
    folder = Path(path).parent
    vertices, times = job["vertices"], job["times"]
    width, height = map(int, job["size"])
    cycles.start(width, height, int(job["samples"]), int(job["threads"]))
    count = len(vertices)
    body = cycles.Body({
        "vertices": vertices[0], "vertex_start": np.array([0, vertices.shape[1]]), "face_start": np.zeros(2, int),
        "faces": job["faces"], "colors": job["colors"], "radius": 0.0,
    })  # fmt: skip
    body.show(0)
    body.object.shape_key_add(name="frame 0", from_mix=False)
    for k in range(1, count):
        key = body.object.shape_key_add(name=f"frame {k}", from_mix=False)
        key.data.foreach_set("co", np.ascontiguousarray(vertices[k], np.float32).ravel())
    keys = body.object.data.shape_keys
    keys.use_relative = False
    scene = bpy.context.scene
    scene.render.fps = RATE
    for time, key in zip(times, keys.key_blocks, strict=True):
        keys.eval_time = key.frame
        keys.keyframe_insert("eval_time", frame=float(time) * RATE)
    _interpolate_linearly(keys)
    scene.frame_start, scene.frame_end = 0, max(1, int(np.ceil(times[-1] * RATE)))
    camera = cycles.add_camera(float(job["focal"]), width)
    cycles.place(camera, job["pose"])
    stand = Matrix.Rotation(np.pi / 2, 4, "X")  # from y up to z up
    bpy.context.view_layer.update()
    for each in scene.objects:
        each.matrix_world = stand @ each.matrix_world
    _animate(cycles.Obstacles(job, shadows=True), times, stand)
    preview = float(job["preview_time"] * RATE)
    scene.frame_set(int(preview), subframe=preview % 1)
    cycles.render(folder / "proof.png")
    scene.frame_set(0)
    # keep the folder of the render out of the file
    scene.render.filepath = ""
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "motion.blend"), compress=True)


def _animate(obstacles: cycles.Obstacles, times: np.ndarray, stand: Matrix) -> None:
    """Key frames of the poses of obstacles, rotated by a matrix."""
    for frame, time in enumerate(times):
        obstacles.show(frame)
        for each in obstacles.objects:
            before = each.rotation_quaternion.copy()
            each.rotation_mode = "QUATERNION"
            each.matrix_world = stand @ each.matrix_world
            each.rotation_quaternion.make_compatible(before)
            for path in ("location", "rotation_quaternion"):
                each.keyframe_insert(path, frame=float(time) * RATE)
    for each in obstacles.objects:
        _interpolate_linearly(each)


def _interpolate_linearly(animated: bpy.types.ID) -> None:
    for curve in animated.animation_data.action.fcurves:
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"


if __name__ == "__main__":
    main(sys.argv[1])
