"""A scene in one HTML file that needs no server and loads nothing: quantised frames, and a renderer of our own.

The frames are whole numbers of 16 or 8 bits between the ends of each component, written as differences from the frame
before, low bytes first, and deflated. ``page.js`` undoes it and draws the Gaussians with WebGL 2.
"""

from __future__ import annotations

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

from neuma_lib.errors import InputError
from neuma_lib.extras import require
from neuma_lib.io.files import write_text
from neuma_lib.viewer.scalars import QUANTITIES
from neuma_lib.viewer.scene import Motion, Scene, View, frame_at

COLOURS = {None: "viridis", 1.0: "coolwarm"}
"""Colour map by the middle of a quantity."""
_WEBP = {"format": "WEBP", "quality": 80, "method": 4}
_HERE = Path(__file__)


class Blob:
    """Arrays one after the other in one stream, and what is needed to find and decode them."""

    def __init__(self):
        self.parts: list[bytes] = []
        self._size = 0

    def add(self, content: bytes) -> int:
        """Append bytes; where they begin."""
        start = self._size
        self.parts.append(content)
        self._size += len(content)
        return start

    def frames(self, values: np.ndarray, bits: int = 16, ends: tuple[float, float] | None = None) -> dict:
        """Append values (T, C, M), each component between its own ends, or all between the given ones."""
        T, C, M = values.shape
        if ends is None:
            low, high = values.min(axis=(0, 2)), values.max(axis=(0, 2))
        else:
            low, high = np.full(C, ends[0]), np.full(C, ends[1])
        whole = quantised(values, low, high, bits)
        start = self.add(as_differences(whole, bits))
        ends = {"low": low.tolist(), "high": high.tolist()}
        return {"start": start, "frames": T, "components": C, "count": M, "bits": bits, **ends}


def quantised(values: np.ndarray, low: np.ndarray, high: np.ndarray, bits: int) -> np.ndarray:
    """Whole numbers (T, C, M), 0 at ``low`` and 2^bits - 1 at ``high``, (C,) each; what lies outside is clipped."""
    span = np.maximum(high - low, 1e-30)
    share = (values - low[:, None]) / span[:, None]
    top = 2**bits - 1
    return (np.clip(share, 0, 1) * top).round().astype(np.uint16 if bits == 16 else np.uint8)


def as_differences(whole: np.ndarray, bits: int) -> bytes:
    """Frames (T, ...) as differences from the one before, small numbers for small ones of either sign."""
    kind = np.dtype(f"int{bits}")
    steps = whole.copy()
    steps[1:] -= whole[:-1]
    signed = steps.view(kind)
    zigzag = ((signed << 1) ^ (signed >> (bits - 1))).view(f"<u{bits // 8}")
    flat = zigzag.reshape(-1).view(np.uint8).reshape(-1, bits // 8)
    return np.ascontiguousarray(flat.T).tobytes()


def roots(covars: Tensor) -> np.ndarray:
    """Symmetric square roots of covariances (T, G, 3, 3), their six upper entries as (T, 6, G).

    In the size of a Gaussian, not its square: quantising them costs large and flat ones the same fraction.
    """
    values, vectors = torch.linalg.eigh(covars.double())
    half = (vectors * values.clamp_min(0).sqrt()[..., None, :]) @ vectors.mT
    rows, columns = np.triu_indices(3)
    return half[..., rows, columns].transpose(1, 2).numpy()


def page(scene: Scene, particles: int = 8000, megabytes: float = 25) -> str:
    """The text of the file.

    Args:
        particles: most of each motion that are shown; some are left out evenly where there are more.
        megabytes: largest size of the file [MB]; where it is too small, every second frame is left out, and again.

    Raises:
        InputError: not even first and last frame fit.
    """
    steps = scene.steps
    stride = 1
    while True:
        kept = tuple(steps[::stride]) if (len(steps) - 1) % stride == 0 else (*steps[::stride], steps[-1])
        text = _filled(scene, kept, particles)
        if len(text) <= megabytes * 1e6:
            return text
        if len(kept) <= 2:
            raise InputError(
                f"{scene.name}: two frames take {len(text) / 1e6:.1f} MB; raise viewer.megabytes ({megabytes:g}), or "
                "lower viewer.particles or the number of viewer.methods"
            )
        stride *= 2


def write_page(path: str | Path, scene: Scene, particles: int = 8000, megabytes: float = 25) -> int:
    """Write `page`; its size in bytes."""
    text = page(scene, particles, megabytes)
    write_text(path, text)
    return len(text)


def _filled(scene: Scene, steps: tuple[int, ...], particles: int) -> str:
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
        "quantities": {
            name: {
                "label": quantity.label,
                "unit": quantity.unit,
                "range": scene.ranges[name],
                "map": COLOURS[quantity.middle],
            }
            for name, quantity in known.items()
        },
        "maps": {name: colour_map(name) for name in COLOURS.values()},
        "notes": list(scene.notes),
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
    """256 colours of matplotlib's map of that name, 768 numbers from 0 to 255."""
    colours = require("matplotlib", "viewer").colormaps[name](np.arange(256))[:, :3]
    return (colours * 255).round().astype(int).ravel().tolist()


def _motion(scene: Scene, motion: Motion, steps: tuple[int, ...], particles: int, blob: Blob) -> dict:
    at = [frame_at(motion.steps, step) for step in steps]
    stride = -(-motion.x.shape[1] // particles)
    x = motion.x[at, ::stride]
    radius = (scene.volume / x.shape[1] * 3 / (4 * np.pi)) ** (1 / 3)
    found: dict[str, Any] = {
        "name": motion.name,
        "title": motion.title,
        "radius": radius,
        "x": blob.frames(x.transpose(1, 2).numpy()),
        "scalars": {
            name: blob.frames(values[at, ::stride][:, None].numpy(), bits=8, ends=scene.ranges[name])
            for name, values in motion.scalars.items()
        },
    }
    if motion.means is not None:
        found["means"] = blob.frames(motion.means[at].transpose(1, 2).numpy())
        found["roots"] = blob.frames(roots(motion.covars[at]))
    return found


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
