"""Blender in a separate process, since its libraries conflict with those of others, and a reader of .blend files."""

import importlib.util
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

needs_blender = pytest.mark.skipif(importlib.util.find_spec("bpy") is None, reason="needs Blender (bpy)")
READ = """
import sys, json, bpy, numpy as np
bpy.ops.wm.open_mainfile(filepath=sys.argv[1])
scene, body = bpy.context.scene, bpy.data.objects["body"]
around = [each for each in bpy.data.objects if each.name.startswith("obstacle")]
seen, poses = [], []
for time in json.loads(sys.argv[2]):
    frame = time * scene.render.fps
    scene.frame_set(int(frame), subframe=frame % 1)
    mesh = body.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    co = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", co)
    seen.append(co.reshape(-1, 3))
    poses.append(np.array([each.matrix_world for each in around]))
parts = {"co": np.stack(seen), "world": np.array(body.matrix_world), "poses": np.stack(poses, axis=1)}
np.savez(sys.argv[3], **parts)
"""


def read_blend(path, times):
    """Vertices "co" (T, n, 3) of the object "body" at times [s], its matrix "world" (4, 4), and those of obstacles,
    "poses" (K, T, 4, 4).
    """
    with tempfile.TemporaryDirectory() as folder:
        script, output = Path(folder, "read.py"), Path(folder, "read.npz")
        script.write_text(READ)
        command = [sys.executable, str(script), str(path), json.dumps(times), str(output)]
        subprocess.run(command, check=True, stdout=subprocess.PIPE)
        return dict(np.load(output))
