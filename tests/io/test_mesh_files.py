"""Mesh files of other programs: all formats give the same triangles, and hostile files give an error within bounds."""

import json
import struct
import subprocess
import sys

import numpy as np
import pytest
import trimesh

from neuma_lib.io import child
from neuma_lib.io.mesh_files import MAX_FACES, MAX_MESH_BYTES, read_any_mesh
from tests.support.errors import refused

pytestmark = pytest.mark.core

BOX = trimesh.creation.box((0.1, 0.2, 0.3)).apply_translation([1.0, 2.0, 3.0])


@pytest.mark.parametrize("suffix", ["obj", "ply", "glb", "STL"])
def test_formats_have_the_same_triangles(tmp_path, suffix):
    path = tmp_path / f"a box.{suffix}"
    BOX.export(path, file_type=suffix.lower())
    mesh = read_any_mesh(path)
    np.testing.assert_allclose(mesh.triangles, BOX.triangles, atol=1e-6)


def glb(**parts) -> bytes:
    """A binary glTF file with a triangle, parts of which are replaced."""
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "buffers": [{"byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
    } | parts
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text
    body += struct.pack("<II", 36, 0x004E4942) + np.eye(3, dtype="<f4").tobytes()
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
CLAIM = "element vertex 4000000000\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
HOSTILE = {
    "zeros.glb": glb(accessors=[{"componentType": 5126, "count": 10**10, "type": "VEC3"}]),
    "stride.glb": glb(bufferViews=[{"buffer": 0, "byteLength": 36, "byteStride": 252}]),
    "file.glb": glb(buffers=[{"byteLength": 36, "uri": "secret.bin"}]),
    "claim.ply": f"ply\nformat binary_little_endian 1.0\n{CLAIM}".encode(),
    "claim.stl": bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50),
    "index.obj": TRIANGLE.replace("3\n", "99\n").encode(),
    "point.obj": b"v 1 1 1\n" * 3 + b"f 1 2 3\n",
    "infinite.obj": TRIANGLE.replace("1", "inf", 1).encode(),
    "faces.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + b"f 1 2 3\n" * (MAX_FACES + 1),
    "mesh.blend": b"BLENDER",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_end_in_one_line(tmp_path, name):
    (tmp_path / name).write_bytes(HOSTILE[name])
    (tmp_path / "secret.bin").write_bytes(np.eye(3, dtype="<f4").tobytes())
    with refused(name):
        read_any_mesh(tmp_path / name)


def test_hostile_files_need_little_memory(tmp_path):
    """In a new process, whose children are those of the readers alone."""
    for name, content in HOSTILE.items():
        (tmp_path / name).write_bytes(content)
    code = """if True:
        import resource, sys
        from neuma_lib.errors import InputError
        from neuma_lib.io.mesh_files import read_any_mesh
        for path in sys.argv[1:]:
            try:
                read_any_mesh(path)
            except InputError:
                continue
            raise SystemExit(path)
        print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
    """
    command = [sys.executable, "-c", code, *(str(tmp_path / name) for name in HOSTILE)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(done.stdout) < 500_000  # kB


def test_other_files_are_not_read(tmp_path):
    path = tmp_path / "cup.obj"
    path.write_text(f"mtllib /etc/passwd\n{TRIANGLE}")
    assert len(read_any_mesh(path).faces) == 1
    with refused("cap.obj", remedy="relative to the project's folder"):
        read_any_mesh(tmp_path / "cap.obj")
    with path.open("ab") as file:
        file.truncate(MAX_MESH_BYTES + 1)
    with refused("cup.obj", problem="32 are read"):
        read_any_mesh(path)


def exhaust(path):
    return {"zeros": np.ones(2**31)}


def end(path):
    import os

    os._exit(3)


def wait(path):
    import time

    time.sleep(60)


@pytest.mark.parametrize(
    ("reader", "problem"), [("exhaust", "memory"), ("end", "status 3"), ("wait", "within 1 s")]
)
def test_a_child_ends_within_its_bounds(monkeypatch, reader, problem):
    if reader == "wait":
        monkeypatch.setattr(child, "MAX_SECONDS", 1)
    with refused("some.file", problem=problem):
        child.arrays_from_child(f"{__name__}:{reader}", "some.file", "a mesh")
