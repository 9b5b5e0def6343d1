"""The simulator from its settings, whose colliders, clamps and pairs are plain and may name the files of meshes."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from neuma_lib.config.obstacles import is_mesh_file
from neuma_lib.errors import InputError
from neuma_lib.sim.bodies import Pair
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.colliders import Collider
from neuma_lib.sim.model import MPM


def simulator(constants: Mapping[str, Any]) -> MPM:
    """The simulator of the parameters of a stage. Arguments and errors as for `with_obstacles`."""
    return MPM(**with_obstacles(constants))


def with_obstacles(constants: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `MPM` with colliders, clamps and pairs in place of their settings (`ColliderConfig.arguments`).

    Raises:
        InputError: a value is wrong, or the file of a mesh cannot be read. It names the entry.
    """
    arguments = dict(constants)
    makers = {"colliders": _collider, "clamps": lambda own: Clamp(**own), "pairs": lambda own: Pair(**own)}
    for name, make in makers.items():
        made = []
        for k, settings in enumerate(constants.get(name, ())):
            try:
                made.append(make(settings))
            except InputError as error:
                where = f"{name}.{k}.{error.where.removeprefix(f'{name[:-1]}.')}"
                raise InputError(where, error.problem, error.remedy) from None
        arguments |= {name: tuple(made)} if made else {}
    return arguments


def _collider(settings: Mapping[str, Any]) -> Collider:
    if not is_mesh_file(settings["shape"]):
        return Collider(**settings)
    # Here, because they import trimesh, which takes longer than many a job.
    from neuma_lib.geometry.mesh_collider import mesh_collider
    from neuma_lib.io.mesh_files import read_any_mesh

    mesh = read_any_mesh(settings["shape"])
    mesh.merge_vertices()  # some formats store the corners of each triangle
    (longest,) = settings["size"]
    scale = longest / float(mesh.extents.max())
    mesh.vertices = scale * (mesh.vertices - np.mean(mesh.bounds, axis=0))
    options = {key: value for key, value in settings.items() if key not in ("shape", "size")}
    return mesh_collider(mesh, **options)
