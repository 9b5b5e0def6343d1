"""Colour of a solid as a function of the rest position: part colours with smooth noise, which makes motion visible.

The same function colours mesh vertices, sand grains and the surface of a liquid (through the particles below it).
"""

import numpy as np
import trimesh

from neuma_lib.config.blender import AppearanceConfig
from neuma_lib.errors import InputError
from neuma_lib.geometry import shapes

BORDER = 0.008  # width of the borders between parts [m]


def parse_color(text: str) -> np.ndarray:
    """ "#rrggbb" as three sRGB values in [0, 1].

    Raises:
        InputError: another form.
    """
    digits = text.removeprefix("#")
    try:
        if len(digits) != 6:
            raise ValueError
        return np.array([int(digits[i : i + 2], 16) for i in (0, 2, 4)]) / 255.0
    except ValueError:
        raise InputError("colors", f"{text!r} is not of the form '#rrggbb', for example '#f2c83d'") from None


def smooth_noise(points: np.ndarray, scale: float, seed: int) -> np.ndarray:
    """Value noise in [0, 1] with two octaves at points (n, 3) [m] -> (n,); ``scale`` [m] is the lattice spacing."""
    total = np.zeros(len(points))
    for octave, amplitude in enumerate((0.7, 0.3)):
        rng = np.random.default_rng([seed, octave])
        lattice = rng.random((32, 32, 32))
        position = points / scale * 2.0**octave + rng.random(3) * 32
        cell = np.floor(position).astype(np.int64)
        t = position - cell
        t = t * t * (3.0 - 2.0 * t)
        value = np.zeros(len(points))
        for corner in np.ndindex(2, 2, 2):
            weight = np.prod(np.where(corner, t, 1.0 - t), axis=1)
            value += weight * lattice[tuple(((cell + corner) % 32).T)]
        total += amplitude * value
    return total


def colors_at(mesh: trimesh.Trimesh, points: np.ndarray, appearance: AppearanceConfig) -> np.ndarray:
    """sRGB colours (n, 3) in [0, 1] at rest positions (n, 3) [m] in the frame of a mesh from ``shapes.build``.

    Raises:
        InputError: a colour of a part that a shape of several parts does not have, or no colour of ``body``.
    """
    solid, nominal = shapes.to_nominal(mesh, points)
    names = solid.part_names
    unknown = set(appearance.colors) - set(names)
    if unknown and len(names) > 1:
        problem = f"shape {mesh.metadata['shape']!r} has no part {sorted(unknown)}; its parts are {', '.join(names)}"
        raise InputError("colors", problem)
    if "body" not in appearance.colors:
        raise InputError("colors", "must have a colour of 'body'")
    plain = np.stack([parse_color(appearance.colors.get(name, appearance.colors["body"])) for name in names])
    patched = 0.6 * plain
    if appearance.accent:
        patched[names.index("body")] = parse_color(appearance.accent)
    weights = solid.part_weights(nominal, BORDER / mesh.metadata["scale"])
    noise = smooth_noise(np.asarray(points, dtype=np.float64), appearance.scale, appearance.seed)
    # a smooth step with edges of about a centimetre, because sharp edges need more Gaussians
    patch = np.clip((noise - 0.35) / 0.3, 0.0, 1.0)
    patch = (appearance.contrast * patch * patch * (3.0 - 2.0 * patch))[:, None]
    return (1.0 - patch) * (weights @ plain) + patch * (weights @ patched)
