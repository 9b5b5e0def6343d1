"""Prescribed rigid motions of colliders and clamps."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple, Self

import torch
from torch import Tensor

from neuma_lib.errors import InputError

Vector = tuple[float, float, float]
AT_REST = {"velocity": (0.0, 0.0, 0.0), "spin": (0.0, 0.0, 0.0), "keyframes": ()}


class Motion:
    """Pose of a frame over time. Base of frozen dataclasses with these fields:"""

    centre: Vector  # origin of the frame at t = 0 [m]
    rotation: Vector  # rotation vector of the frame at t = 0 [rad]
    velocity: Vector  # of the centre [m/s]
    spin: Vector  # angular velocity about the centre [rad/s]
    # poses (time [s], centre [m], rotation vector [rad]) in place of the other four, with ascending times.
    # Between two of them the centre moves at constant velocity and the frame turns by the smallest angle at
    # constant angular velocity. Before the first and after the last it rests.
    keyframes: tuple[tuple[float, Vector, Vector], ...]

    def check_motion(self, name: str) -> None:
        """Store the fields as numbers. Raises InputError, with ``name`` for the object, if a value is wrong."""
        for field in ("centre", "rotation", "velocity", "spin"):
            object.__setattr__(self, field, vector(getattr(self, field), f"{name}.{field}"))
        where = f"{name}.keyframes"
        if not self.keyframes:
            object.__setattr__(self, "keyframes", ())
            return
        try:
            frames = [(float(time), centre, rotation) for time, centre, rotation in self.keyframes]
        except (TypeError, ValueError):
            problem = f"{self.keyframes!r} must be entries of time [s], centre [m] and rotation vector [rad]"
            raise InputError(where, problem) from None
        times = [time for time, _, _ in frames]
        if not all(map(math.isfinite, times)) or any(b <= a for a, b in pairwise(times)):
            raise InputError(where, f"times {times} s must be finite and ascending")
        if any((*self.centre, *self.rotation, *self.velocity, *self.spin)):
            raise InputError(where, "exclude centre, rotation, velocity and spin", "Remove one or the other")
        checked = tuple((time, vector(c, where), vector(r, where)) for time, c, r in frames)
        object.__setattr__(self, "keyframes", checked)

    @property
    def moves(self) -> bool:
        """Whether the frame ever moves."""
        return any(bool(piece.velocity.any() or piece.spin.any()) for piece in self._pieces)

    def fastest(self, until: float) -> float:
        """Upper bound of the speed [m/s] of its points in the unit cube, from t = 0 to a time [s]."""
        speeds = []
        for piece in self._pieces:
            speed = float(piece.velocity.norm())
            away = math.dist(piece.centre.tolist(), (0.5, 0.5, 0.5))
            reach = math.sqrt(3.0) / 2 + away + (speed * max(0.0, until - piece.time) if speed else 0.0)
            speeds.append(speed + float(piece.spin.norm()) * reach)
        return max(speeds)

    def pose(self, time: float) -> tuple[Tensor, Tensor]:
        """Axes (3, 3) of the frame as columns, and centre (3,) [m], both float64, at a time [s]."""
        piece = self._piece(time)
        elapsed = time - piece.time
        axes = turned(elapsed * piece.spin) @ piece.axes if piece.spin.any() else piece.axes
        return axes, piece.centre + elapsed * piece.velocity if piece.velocity.any() else piece.centre

    def rates(self, time: float) -> tuple[Tensor, Tensor]:
        """Velocity (3,) of the centre [m/s] and spin (3,) [rad/s], both float64, just after a time [s]."""
        piece = self._piece(time)
        return piece.velocity, piece.spin

    def velocity_at(self, x: Tensor, time: float = 0.0) -> Tensor:
        """Velocity [m/s] of the points of the frame that are at x (..., 3)."""
        _, centre = self.pose(time)
        velocity, spin = (rate.to(x) for rate in self.rates(time))
        return velocity + torch.linalg.cross(spin.expand_as(x), x - centre.to(x))

    def in_step(self, time: float, dt: float) -> tuple[Tensor, Tensor, Tensor]:
        """Rigid motion from a time to ``time + dt`` [s] as a field of velocities A (x - centre) + velocity.

        Returns:
            A (3, 3) [1/s], centre (3,) [m] and velocity (3,) [m/s], float64.
        """
        (axes, centre), (next_axes, next_centre) = self.pose(time), self.pose(time + dt)
        A = (next_axes @ axes.mT - torch.eye(3, dtype=torch.float64)) / dt
        return A, centre, (next_centre - centre) / dt

    def at_rest(self) -> Self:
        """The same object, fixed in its pose at t = 0."""
        axes, centre = self.pose(0.0)
        pose = {"centre": tuple(centre.tolist()), "rotation": tuple(rotation_vector(axes).tolist())}
        return replace(self, **pose, **AT_REST) if self.moves else self  # type: ignore[type-var]

    def later(self, time: float) -> Self:
        """The same object with t = 0 at a later time [s]."""
        if self.keyframes:
            frames = tuple((moment - time, *pose) for moment, *pose in self.keyframes)
            return replace(self, keyframes=frames)  # type: ignore[type-var]
        axes, centre = self.pose(time)
        pose = {"centre": tuple(centre.tolist()), "rotation": tuple(rotation_vector(axes).tolist())}
        return replace(self, **pose) if self.moves else self  # type: ignore[type-var]

    @cached_property
    def _pieces(self) -> "tuple[_Piece, ...]":
        """Intervals of constant velocity and spin. The first also covers the time before it."""
        if not self.keyframes:
            start, velocity, spin = turned(_tensor(self.rotation)), _tensor(self.velocity), _tensor(self.spin)
            return (_Piece(0.0, start, _tensor(self.centre), velocity, spin),)
        rest = torch.zeros(3, dtype=torch.float64)
        poses = [(t, turned(_tensor(rotation)), _tensor(centre)) for t, centre, rotation in self.keyframes]
        pieces = [_Piece(-math.inf, *poses[0][1:], rest, rest)]
        for (t0, axes, centre), (t1, next_axes, next_centre) in pairwise(poses):
            spin = rotation_vector(next_axes @ axes.mT) / (t1 - t0)
            pieces.append(_Piece(t0, axes, centre, (next_centre - centre) / (t1 - t0), spin))
        return (*pieces, _Piece(*poses[-1], rest, rest))

    def _piece(self, time: float) -> "_Piece":
        return next((piece for piece in reversed(self._pieces) if piece.time <= time), self._pieces[0])


class _Piece(NamedTuple):
    """Interval of constant velocity and spin from a time [s] on, with the pose at that time."""

    time: float
    axes: Tensor
    centre: Tensor
    velocity: Tensor
    spin: Tensor


def turned(rotation: Tensor) -> Tensor:
    """Rotation matrix (3, 3) of a rotation vector (3,) [rad]."""
    from scipy.spatial.transform import Rotation  # here, because the import takes a quarter of a second

    return torch.from_numpy(Rotation.from_rotvec(rotation.numpy()).as_matrix())


def rotation_vector(matrix: Tensor) -> Tensor:
    """Rotation vector (3,) [rad], of at most pi, of a rotation matrix (3, 3)."""
    from scipy.spatial.transform import Rotation

    return torch.from_numpy(Rotation.from_matrix(matrix.numpy()).as_rotvec())


def vector(value: Sequence[float], where: str, count: int = 3, problem: str = "") -> tuple[float, ...]:
    """A sequence as that many finite numbers. Raises InputError."""
    try:
        numbers = tuple(float(v) for v in value)
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)) or len(numbers) != len(value):
        raise InputError(where, f"{value!r} {problem or 'must be three finite numbers'}")
    return numbers


def _tensor(value: Sequence[float]) -> Tensor:
    return torch.tensor(value, dtype=torch.float64)
