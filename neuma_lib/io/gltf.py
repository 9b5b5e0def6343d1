"""A moving surface as binary glTF 2.0: a mesh with one morph target per frame, and an animation of their weights."""

import json
import struct
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from neuma_lib.geometry.obstacles import Obstacle
from neuma_lib.io.files import atomic

_FLOAT, _UINT = 5126, 5125
_ROUGH = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
_VERTICES, _FACES = 34962, 34963
"""Buffer targets of a mesh."""


def write_glb(
    path: str | Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    times: np.ndarray,
    colors: np.ndarray,
    obstacles: Sequence[Obstacle] = (),
    bodies: Sequence[tuple[str, int]] = (),
) -> None:
    """Write a moving surface, y up and in metres as glTF requires.

    Args:
        vertices: (T, V, 3) [m].
        faces: (M, 3).
        times: (T,) ascending [s]; vertices are interpolated linearly in between.
        colors: (V, 3) sRGB in [0, 1].
        obstacles: other nodes of the scene, with a pose at each time.
        bodies: names and numbers of vertices of the bodies in their order, each a node of its name; (): one body.
    """
    vertices = np.asarray(vertices, "<f4")
    frames, body, views, accessors = len(vertices), bytearray(), [], []

    def add(array: np.ndarray, kind: str, target: int | None = None, bounds: bool = False) -> int:
        view = {"buffer": 0, "byteOffset": len(body), "byteLength": array.nbytes}
        views.append(view | ({"target": target} if target else {}))
        body.extend(array.tobytes())
        entry: dict[str, Any] = {"bufferView": len(views) - 1, "count": len(array), "type": kind}
        entry["componentType"] = _UINT if array.dtype == np.uint32 else _FLOAT
        if bounds:
            rows = array.reshape(len(array), -1)
            entry |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        accessors.append(entry)
        return len(accessors) - 1

    colors, meshes = linear(colors).astype("<f4"), []
    bodies = bodies or [("body", vertices.shape[1])]
    names = mesh_names(bodies, len(obstacles))
    for name, (own, faces_of) in zip(names, parts_of(faces, bodies), strict=False):
        part = vertices[:, own]
        indices = add(np.asarray(faces_of, "<u4").ravel(), "SCALAR", _FACES)
        attributes = {"POSITION": add(part[0], "VEC3", _VERTICES, bounds=True)}
        attributes["COLOR_0"] = add(colors[own], "VEC3", _VERTICES)
        primitive: dict[str, Any] = {"attributes": attributes, "indices": indices, "material": 0}
        mesh: dict[str, Any] = {"name": name, "primitives": [primitive]}
        if frames > 1:  # glTF does not allow empty lists
            targets = [add(frame - part[0], "VEC3", _VERTICES, bounds=True) for frame in part[1:]]
            primitive["targets"] = [{"POSITION": target} for target in targets]
            mesh["weights"] = [0.0] * (frames - 1)
        meshes.append(mesh)
    weights = np.eye(frames, dtype="<f4")[:, 1:]  # the first frame is the mesh itself
    animated = {
        "input": add(np.asarray(times, "<f4"), "SCALAR", bounds=True),
        "output": add(weights.reshape(-1, 1), "SCALAR"),
        "interpolation": "LINEAR",
    }
    channels = [{"sampler": 0, "target": {"node": k, "path": "weights"}} for k in range(len(meshes))]
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "neuma_lib"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [{"mesh": k, "name": mesh["name"]} for k, mesh in enumerate(meshes)],
        "meshes": meshes,
        "materials": [{"pbrMetallicRoughness": _ROUGH}],
        "animations": [{"samplers": [animated], "channels": channels}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    if frames == 1:
        del content["animations"]
    for k, (name, obstacle) in enumerate(zip(names[len(bodies) :], obstacles, strict=True), 1):
        corners = {"POSITION": add(np.asarray(obstacle.vertices, "<f4"), "VEC3", _VERTICES, bounds=True)}
        triangles = add(np.asarray(obstacle.faces, "<u4").ravel(), "SCALAR", _FACES)
        look = {"baseColorFactor": [*linear(obstacle.color), obstacle.opacity]}
        content["materials"].append({"pbrMetallicRoughness": look | _ROUGH, "doubleSided": True})
        part = {"attributes": corners, "indices": triangles, "material": k}
        content["meshes"].append({"name": name, "primitives": [part]})
        turns = Rotation.from_matrix(obstacle.poses[:, :3, :3]).as_quat(canonical=True)
        turns[1:] *= np.cumprod(np.where((turns[1:] * turns[:-1]).sum(1, keepdims=True) < 0, -1, 1), axis=0)
        motion = {"translation": obstacle.poses[:, :3, 3], "rotation": turns}
        start = {key: values[0].tolist() for key, values in motion.items()}
        node = len(content["nodes"])
        content["nodes"].append({"mesh": node, "name": name, **start})
        content["scenes"][0]["nodes"].append(node)
        for key, values in motion.items() if obstacle.moves else ():
            moved = content["animations"][0]
            kind = "VEC3" if key == "translation" else "VEC4"
            output = add(np.asarray(values, "<f4"), kind)
            target = {"node": node, "path": key}
            moved["channels"].append({"sampler": len(moved["samplers"]), "target": target})
            moved["samplers"].append(animated | {"output": output})
    content["buffers"][0]["byteLength"] = len(body)
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    with atomic(path) as partial:
        headers = [struct.pack("<II", len(text), 0x4E4F534A), struct.pack("<II", len(body), 0x004E4942)]
        parts = (headers[0], text, headers[1], body)
        size = 12 + sum(map(len, parts))
        partial.write_bytes(struct.pack("<4sII", b"glTF", 2, size) + b"".join(map(bytes, parts)))


def mesh_names(
    bodies: Sequence[tuple[str, int]], obstacles: int, valid: Callable[[str], str] = str
) -> list[str]:
    """Different names of the meshes of bodies and then of obstacles, of which an equal one gets its number."""
    names: list[str] = []
    for name in map(valid, (*(name for name, _ in bodies), *(f"obstacle {k + 1}" for k in range(obstacles)))):
        while name in names:
            name = f"{name}_{len(names) + 1}"
        names.append(name)
    return names


def parts_of(faces: np.ndarray, bodies: Sequence[tuple[str, int]]) -> Iterator[tuple[slice, np.ndarray]]:
    """Vertices and faces (M_k, 3) of each body of a surface, counted from its first vertex."""
    first, faces = 0, np.asarray(faces)
    for _, count in bodies:
        own = slice(first, first + count)
        yield own, faces[(faces[:, 0] >= own.start) & (faces[:, 0] < own.stop)] - first
        first = own.stop


def linear(srgb: ArrayLike) -> np.ndarray:
    """Linear colours from sRGB (IEC 61966-2-1), both in [0, 1]."""
    c = np.clip(np.asarray(srgb, np.float64), 0, 1)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
