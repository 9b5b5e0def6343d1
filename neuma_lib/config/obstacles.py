"""Settings of obstacles in a scene, as the arguments of `neuma_lib.sim.colliders`."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Self

from pydantic import Field, model_validator

from neuma_lib.config.base import Section, Vector
from neuma_lib.config.validation import hint
from neuma_lib.errors import InputError

MESH_SUFFIXES = (".obj", ".ply", ".stl", ".glb")
LENGTHS = {
    "plane": (),
    "box": ("half width", "half height", "half depth"),
    "sphere": ("radius",),
    "capsule": ("half length", "radius"),
}
"""Lengths that describe each shape, as of `neuma_lib.sim.colliders`, which settings do not import."""
UP = (0.0, 1.0, 0.0)
KeyFrames = tuple[tuple[float, Vector, Vector], ...]


def is_mesh_file(shape: str | None) -> bool:
    """Whether a shape is the path of a mesh, and not the name of a built-in shape."""
    return shape is not None and shape.lower().endswith(MESH_SUFFIXES)


class ColliderConfig(Section):
    """A rigid obstacle, in addition to the faces of the cube.

    Its size [m] is: none for a plane, which fills the space below; half width, height and depth of a box; radius of a
    sphere; half the length without the ends, and radius of a capsule; longest side of a mesh.
    """

    shape: str = Field(
        description="plane, box, sphere, capsule, or the path of a closed mesh (.obj, .ply, .stl, .glb)"
    )
    size: tuple[float, ...] = Field((), description="lengths of the shape [m], see above")
    centre: Vector = Field(
        (0.0, 0.0, 0.0), description="centre, or a point of a plane [m]; of a mesh that of its bounding box"
    )
    axis: Vector = Field(
        UP, description="direction of the shape's y axis: the normal of a plane, the axis of a capsule"
    )
    rotation: Vector = Field((0.0, 0.0, 0.0), description="rotation vector, in place of axis [rad]")
    friction: float | None = Field(None, ge=0, description="Coulomb coefficient; null: bodies stick")
    damping: float = Field(
        0.0, ge=0, le=1, description="part of the approaching velocity that contact removes; 0: elastic"
    )
    velocity: Vector = Field((0.0, 0.0, 0.0), description="velocity of the centre [m/s]")
    spin: Vector = Field((0.0, 0.0, 0.0), description="angular velocity about the centre [rad/s]")
    keyframes: KeyFrames = Field(
        (),
        description="poses in place of centre, rotation, velocity and spin: time [s], centre [m] and rotation vector "
        "[rad] of each",
    )

    @model_validator(mode="after")
    def _shape_is_whole(self) -> Self:
        if is_mesh_file(self.shape):
            lengths: Sequence[str] = ("longest side",)
        elif self.shape in LENGTHS:
            lengths = LENGTHS[self.shape]
        else:
            known = [*LENGTHS, "a file.obj"]
            raise InputError("shape", f"{self.shape!r} is unknown{hint(self.shape, known)}")
        if len(self.size) != len(lengths) or not all(length > 0 for length in self.size):
            wanted = f"[{', '.join(lengths)}], positive lengths in metres" if lengths else "left out"
            raise InputError("size", f"{list(self.size)} of a {self.shape} must be {wanted}")
        if not any(self.axis):
            raise InputError("axis", "[0, 0, 0] is no direction", "Give for example [0, 1, 0]")
        if any(self.rotation) and self.axis != UP:
            raise InputError("axis", "a rotation is given, too", "Give one of the two")
        _check_times(self.keyframes)
        placed = (*self.centre, *self.rotation, *self.velocity, *self.spin)
        if self.keyframes and (self.axis != UP or any(placed)):
            problem = "exclude centre, axis, rotation, velocity and spin"
            raise InputError("keyframes", problem, "Leave those out")
        return self

    @property
    def start(self) -> tuple[Vector, Vector]:
        """Centre [m] and rotation vector [rad] at t = 0, or in the first key frame."""
        if self.keyframes:
            return self.keyframes[0][1:]
        return self.centre, self.rotation if self.axis == UP else turned_up(self.axis)

    def arguments(self) -> dict[str, Any]:
        """Arguments of a collider, which JSON can hold. Those at their defaults are left out."""
        given = self.model_dump(mode="json", exclude_defaults=True, exclude={"axis"})
        return given | ({"rotation": list(self.start[1])} if self.axis != UP else {})


class RegionConfig(Section):
    """A box-shaped part of a body."""

    lowest: Vector = Field(description="corner of the region at t = 0 [m]")
    highest: Vector = Field(description="opposite corner, larger on every axis [m]")

    @model_validator(mode="after")
    def _region_is_whole(self) -> Self:
        if not all(low < high for low, high in zip(self.lowest, self.highest, strict=True)):
            raise InputError("highest", f"{list(self.highest)} must exceed lowest on every axis")
        return self


class ClampConfig(RegionConfig):
    """A region of the body that follows a prescribed motion, or is held in place."""

    release: float | None = Field(
        None, gt=0, description="time from which on it moves freely [s]; null: never"
    )
    keyframes: KeyFrames = Field(
        (), description="motion, as of a collider, from its first key frame on; [] holds it"
    )

    @model_validator(mode="after")
    def _times_ascend(self) -> Self:
        _check_times(self.keyframes)
        return self

    def arguments(self) -> dict[str, Any]:
        """Arguments of a clamp, which JSON can hold. Those at their defaults are left out."""
        return self.model_dump(mode="json", exclude_defaults=True)


def _check_times(keyframes: KeyFrames) -> None:
    times = [time for time, _, _ in keyframes]
    if any(after <= before for before, after in pairwise(times)):
        raise InputError("keyframes", f"times {times} s must ascend")


def turned_up(axis: Sequence[float]) -> Vector:
    """The shortest rotation vector [rad] from the y axis to a direction."""
    x, y, z = (component / math.hypot(*axis) for component in axis)
    sine = math.hypot(x, z)
    if sine < 1e-12:  # any axis in the plane turns y to -y
        return (0.0 if y > 0 else math.pi), 0.0, 0.0
    angle = math.atan2(sine, y)
    return angle * z / sine, 0.0, -angle * x / sine
