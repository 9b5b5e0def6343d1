"""Input files as Snakemake hands them to scripts, and as users name them."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from neuma_lib.config.obstacles import is_mesh_file
from neuma_lib.errors import InputError

if TYPE_CHECKING:
    from trimesh import Trimesh

COUNTED = ("all_data.json", "camera.json")
"""Lists of images whose frames are counted, not named by simulated steps (`neuma_lib.io.datasets.layouts`)."""


def image_list(place: str, stride: int | None, key: str, stride_key: str) -> str:
    """The list of images that a setting names, itself or by its folder; one that counts frames needs ``stride``.

    Args:
        key, stride_key: the settings, for messages.
    """
    if Path(place).is_dir():
        lists = [name for name in (*COUNTED, "transforms.json") if Path(place, name).is_file()]
        if len(lists) != 1:
            content = " and ".join(lists) or f"none of {', '.join(COUNTED)}, transforms.json"
            raise InputError(key, f"the folder {place} has {content}", "Give the file that lists the images")
        place = f"{place.rstrip('/')}/{lists[0]}"
    if Path(place).name in COUNTED and stride is None:
        problem = f"missing, but {place} numbers frames"
        raise InputError(stride_key, problem, "Give the simulated steps between two frames")
    return place


def solid(shape: str, meshes: Iterator[str]) -> "str | Trimesh":
    """What `neuma_lib.geometry.shapes.place` needs for a shape: its name, or the user's mesh, repaired.

    Args:
        shape: of a body.
        meshes: files of the repaired meshes of this body and of the next ones that have one.
    """
    from neuma_lib.io.mesh import read_mesh

    return read_mesh(next(meshes)) if is_mesh_file(shape) else shape
