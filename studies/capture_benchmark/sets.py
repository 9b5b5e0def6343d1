"""Files and bodies of the demo captures that the pipeline does not read: the room, and the body in Blender."""

from pathlib import Path

import numpy as np

from neuma_lib.data.blender.appearance import colors_at
from neuma_lib.io.files import atomic
from neuma_lib.io.hdf5 import read_arrays
from studies.capture_benchmark.drops import surfaces
from studies.capture_benchmark.room import Moving, Scenery
from studies.capture_benchmark.settings import DemoCapturesConfig
from studies.capture_benchmark.stage import frame_steps, lying, solid, start

BACKGROUND = "plate_"


def write_room(path: str | Path, where: Scenery, backgrounds: dict[str, np.ndarray]) -> None:
    """Write the room and the backgrounds of the video cameras (an .npz)."""
    values = {name: getattr(where, name) for name in Scenery.__dataclass_fields__ if name != "pictures"}
    pictures = {f"picture{number}": picture for number, picture in enumerate(where.pictures)}
    with atomic(path) as partial, open(partial, "wb") as file:
        np.savez(
            file, **values, **pictures, **{BACKGROUND + name: each for name, each in backgrounds.items()}
        )


def read_room(path: str | Path) -> tuple[Scenery, dict[str, np.ndarray]]:
    """Read the file of `write_room`."""
    with np.load(path) as file:
        values = {name: file[name][()] for name in Scenery.__dataclass_fields__ if name != "pictures"}
        pictures = [file[f"picture{number}"] for number in range(len(values["corners"]))]
        backgrounds = {
            name.removeprefix(BACKGROUND): file[name] for name in file if name.startswith(BACKGROUND)
        }
    return Scenery(pictures=pictures, **values), backgrounds


def body_at_rest(demo: DemoCapturesConfig, name: str) -> Moving:
    """An object at rest, as in its photographs."""
    mesh = solid(demo.objects[name])
    colors = colors_at(mesh, mesh.vertices, demo.objects[name].appearance)
    vertices = lying(demo.objects[name], mesh).apply(mesh.vertices)[None]
    return Moving(vertices, np.zeros_like(vertices), np.asarray(mesh.faces), colors)


def body_of_drop(
    demo: DemoCapturesConfig, name: str, drop: str, particles: str | Path
) -> tuple[Moving, dict[str, np.ndarray]]:
    """The body in a drop, from the file of its particles, and the numbers of its frames for each camera."""
    item = demo.objects[name]
    mesh = solid(item)
    colors = colors_at(mesh, mesh.vertices, item.appearance)
    mesh.vertices = start(item, item.drops[drop], mesh).apply(mesh.vertices)
    arrays, _ = read_arrays(particles, ("frames", "x", "v"), ("frames", "x", "v"))
    surface = surfaces(mesh, arrays["frames"], arrays["x"], arrays["v"])
    frames = {camera: surface.at(frame_steps(demo, camera)) for camera in sorted(demo.cameras)}
    return Moving(surface.vertices, surface.velocities, np.asarray(mesh.faces), colors), frames
