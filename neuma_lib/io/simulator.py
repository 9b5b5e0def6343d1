"""The simulator from its settings, whose colliders are plain and may name the files of meshes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from neuma_lib.errors import InputError
from neuma_lib.sim.colliders import Collider
from neuma_lib.sim.model import MPM


def simulator(constants: Mapping[str, Any]) -> MPM:
    """The simulator of the parameters of a stage. Arguments and errors as for `with_obstacles`."""
    return MPM(**with_obstacles(constants))


def with_obstacles(constants: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `MPM` with colliders in place of their settings (`ColliderConfig.arguments`).

    Raises:
        InputError: a value of a collider is wrong, or the file of a mesh cannot be read. It names the collider.
    """
    colliders = []
    for k, settings in enumerate(constants.get("colliders", ())):
        try:
            colliders.append(Collider(**settings))
        except InputError as error:
            where = f"colliders.{k}.{error.where.removeprefix('collider.')}"
            raise InputError(where, error.problem, error.remedy) from None
    return {**constants, **({"colliders": tuple(colliders)} if colliders else {})}
