"""A scene as one standalone HTML file with quantised frames and a WebGL renderer.

Frames are integers of 16 or 8 bits in the range of each component, stored as differences from the previous frame, low
bytes first, and deflated. ``page.js`` decodes them and renders the Gaussians with WebGL 2.
"""

import base64
import io
import json
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from neuma_lib.coupling.bodies import BODY_COLOURS
from neuma_lib.errors import InputError
from neuma_lib.extras import require
from neuma_lib.geometry.obstacles import Obstacle, obstacles
from neuma_lib.io.files import write_text
from neuma_lib.viewer.scalars import QUANTITIES
from neuma_lib.viewer.scene import Log, Motion, Scene, View, frame_at

COLOURS = {None: "viridis", 1.0: "coolwarm"}  # centre of a quantity's range -> colour map
_WEBP = {"format": "WEBP", "quality": 80, "method": 4}
_HERE = Path(__file__)


class Blob:
    """Stream of concatenated arrays, and metadata to decode them."""

    def __init__(self):
        self.parts: list[bytes] = []
        self._size = 0

    def add(self, content: bytes) -> int:
        """Append bytes and return their offset."""
        start = self._size
        self.parts.append(content)
        self._size += len(content)
        return start

    def frames(self, values: np.ndarray, bits: int = 16, ends: tuple[float, float] | None = None) -> dict:
        """Append values (T, C, M), quantised in the range of each component or in the given one; returns metadata."""
        T, C, M = values.shape
        low, high = ends or (values.min(axis=(0, 2)), values.max(axis=(0, 2)))
        low, high = np.broadcast_to(low, C), np.broadcast_to(high, C)
        start = self.add(as_differences(quantised(values, low, high, bits), bits))
        span = {"low": low.tolist(), "high": high.tolist()}
        return {"start": start, "frames": T, "components": C, "count": M, "bits": bits, **span}


def quantised(values: np.ndarray, low: np.ndarray, high: np.ndarray, bits: int) -> np.ndarray:
    """Integers (T, C, M), 0 at ``low`` and 2^bits - 1 at ``high``, (C,) each; values outside are clipped."""
    span = np.maximum(high - low, 1e-30)
    share = (values - low[:, None]) / span[:, None]
    top = 2**bits - 1
    return (np.clip(share, 0, 1) * top).round().astype(np.uint16 if bits == 16 else np.uint8)


def as_differences(whole: np.ndarray, bits: int) -> bytes:
    """Frames (T, ...) as differences from the previous one, zigzag-encoded, low bytes first."""
    kind = np.dtype(f"int{bits}")
    steps = whole.copy()
    steps[1:] -= whole[:-1]
    signed = steps.view(kind)
    zigzag = ((signed << 1) ^ (signed >> (bits - 1))).view(f"<u{bits // 8}")
    flat = zigzag.reshape(-1).view(np.uint8).reshape(-1, bits // 8)
    return np.ascontiguousarray(flat.T).tobytes()


def roots(covars: Tensor) -> np.ndarray:
    """Symmetric square roots of covariances (T, G, 3, 3), their six upper entries as (T, 6, G).

    They are linear in the size of a Gaussian, which reduces the relative error of quantisation.
    """
    values, vectors = torch.linalg.eigh(covars.double())
    half = (vectors * values.clamp_min(0).sqrt()[..., None, :]) @ vectors.mT
    rows, columns = np.triu_indices(3)
    return half[..., rows, columns].transpose(1, 2).numpy()


def page(scene: Scene, particles: int = 8000, megabytes: float = 25, log: Log = lambda text: None) -> str:
    """The content of the file, with the limits that reduced it.

    Args:
        particles: maximum number of particles per motion; more are subsampled evenly.
        megabytes: maximum size of the file [MB]; every second frame is dropped repeatedly until it fits.
        log: callback for these messages.

    Raises:
        InputError: first and last frame do not fit.
    """
    steps = scene.steps
    stride, limits = 1, []
    for motion in scene.motions:
        if (count := motion.x.shape[1]) > particles:
            drawn = len(motion.x[0, :: _particle_stride(count, particles)])
            limits.append(
                f"{motion.title}: {drawn} of {count} particles (limit: viewer.particles = {particles})"
            )
    while True:
        kept = tuple(steps[::stride]) if (len(steps) - 1) % stride == 0 else (*steps[::stride], steps[-1])
        dropped = f"{len(kept)} of {len(steps)} frames (limit: viewer.megabytes = {megabytes:g})"
        reached = [*limits, dropped] if len(kept) < len(steps) else limits
        text = _filled(scene, kept, particles, reached)
        if len(text) <= megabytes * 1e6:
            for limit in reached:
                log(limit)
            return text
        if len(kept) <= 2:
            problem = (
                f"{megabytes:g} MB are too small for two frames of {scene.name}, {len(text) / 1e6:.1f} MB"
            )
            remedy = "Increase it, or reduce viewer.particles or the number of viewer.methods"
            raise InputError("viewer.megabytes", problem, remedy)
        stride *= 2


def write_page(
    path: str | Path, scene: Scene, particles: int = 8000, megabytes: float = 25, log: Log = lambda text: None
) -> int:
    """Write `page` and return its size in bytes."""
    text = page(scene, particles, megabytes, log)
    write_text(path, text)
    return len(text)


def _particle_stride(count: int, particles: int) -> int:
    return -(-count // particles)


def _filled(scene: Scene, steps: tuple[int, ...], particles: int, limits: list[str]) -> str:
    blob, g = Blob(), scene.gaussians
    sh = g.sh().permute(1, 2, 0).reshape(1, -1, len(g)).numpy()
    known = {name: quantity for name, quantity in QUANTITIES.items() if name in scene.ranges}
    meta: dict[str, Any] = {
        "name": scene.name,
        "dt": scene.dt,
        "steps": list(steps),
        "gaussians": {
            "sh": blob.frames(sh),
            "opacities": blob.frames(g.opacities.reshape(1, 1, -1).numpy(), ends=(0.0, 1.0)),
        },
        "motions": [_motion(scene, motion, steps, particles, blob) for motion in scene.motions],
        "views": [_view(view, steps, blob) for view in scene.views],
        "obstacles": [
            _obstacle(each, blob) for each in obstacles(scene.colliders, [scene.dt * n for n in steps])
        ],
        "quantities": {
            name: {
                "label": quantity.label,
                "unit": quantity.unit,
                "range": scene.ranges[name],
                "map": COLOURS[quantity.middle],
            }
            for name, quantity in known.items()
        },
        "bodies": [
            {"name": name, "color": color} for name, color in zip(scene.bodies, BODY_COLOURS, strict=False)
        ],
        "maps": {name: colour_map(name) for name in COLOURS.values()},
        "notes": list(scene.notes),
        "limits": limits,
    }
    packed = zlib.compress(b"".join(blob.parts), 9)
    parts = {
        "TITLE": scene.name.replace("&", "&amp;").replace("<", "&lt;"),
        "STYLE": _HERE.with_suffix(".css").read_text(),
        "META": json.dumps(meta, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
        "DATA": base64.b64encode(packed).decode(),
        "SCRIPT": _HERE.with_suffix(".js").read_text(),
    }
    template = _HERE.with_suffix(".html").read_text()
    return re.sub("@([A-Z]+)@", lambda place: parts[place[1]], template)


def colour_map(name: str) -> list[int]:
    """256 colours of a matplotlib colour map, 768 integers from 0 to 255."""
    colours = require("matplotlib", "viewer").colormaps[name](np.arange(256))[:, :3]
    return (colours * 255).round().astype(int).ravel().tolist()


def _motion(scene: Scene, motion: Motion, steps: tuple[int, ...], particles: int, blob: Blob) -> dict:
    at = [frame_at(motion.steps, step) for step in steps]
    stride = _particle_stride(motion.x.shape[1], particles)
    x = motion.x[at, ::stride]
    radius = (scene.volume / x.shape[1] * 3 / (4 * np.pi)) ** (1 / 3)
    content: dict[str, Any] = {
        "name": motion.name,
        "title": motion.title,
        "radius": radius,
        "x": blob.frames(x.transpose(1, 2).numpy()),
        "scalars": {
            name: blob.frames(
                values[at, ::stride][:, None].numpy(), bits=8, ends=scene.ranges.get(name, (0, 255))
            )
            for name, values in motion.scalars.items()
        },
    }
    if motion.means is not None:
        content["means"] = blob.frames(motion.means[at].transpose(1, 2).numpy())
        content["roots"] = blob.frames(roots(motion.covars[at]))
    return content


def _obstacle(obstacle: Obstacle, blob: Blob) -> dict:
    """Corners of all triangles in its frame, and its poses in all frames, or one if it rests, row by row."""
    corners = obstacle.vertices[obstacle.faces].reshape(-1, 3)
    poses = obstacle.poses[:, :3] if obstacle.moves else obstacle.poses[:1, :3]
    return {
        "corners": blob.frames(corners.T[None]),
        "poses": poses.reshape(-1, 12).round(6).tolist(),
        "color": list(obstacle.color),
    }


def _view(view: View, steps: tuple[int, ...], blob: Blob) -> dict:
    images = []
    for step in sorted(view.images.keys() & set(steps)):
        buffer = io.BytesIO()
        Image.fromarray(view.images[step]).save(buffer, **_WEBP)
        images.append([step, blob.add(buffer.getvalue()), len(buffer.getvalue())])
    return {
        "number": view.number,
        "viewmat": view.viewmat.ravel().tolist(),
        "focal": [view.K[0, 0], view.K[1, 1]],
        "centre": [view.K[0, 2], view.K[1, 2]],
        "size": [view.width, view.height],
        "images": images,
    }
