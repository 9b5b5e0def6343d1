"""A small image set in the layout of the authors' release."""

import json

import numpy as np
from PIL import Image

K = [[40.0, 0.0, 16.0], [0.0, 41.0, 15.0], [0.0, 0.0, 1.0]]


def write_release(folder, kind="dynamic"):
    """Write a set whose pixel (0, 0) holds view and step, and return its list."""
    (folder / f"data_{kind}").mkdir(parents=True)
    entries = []
    for view in (0, 2):
        for step in (0, 2, 4):
            name = f"./data_{kind}/d_{view}_{step:03d}.png"
            pixels = np.zeros((30, 32, 4), dtype=np.uint8)
            pixels[8:20, 9 + step : 19 + step] = (200, 90, 30, 255)
            pixels[0, 0] = (view, step, 0, 0)
            Image.fromarray(pixels, "RGBA").save(folder / name)
            pose = np.eye(4)
            pose[:3, 3] = (0.5, 0.4 + 0.1 * view, 2.0)
            entries.append({"file_path": name, "c2w": pose.tolist(), "intrinsic": K})
    path = folder / f"data_{kind}.json"
    path.write_text(json.dumps(entries))
    return path
