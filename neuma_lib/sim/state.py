"""Initial state of the particles of a rollout, and their states at its frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.sim.bodies import MAX_BODIES


@dataclass(frozen=True)
class State:
    """N particles at one time. Device and precision (float32 or float64) are those of x.

    Attributes:
        x: positions [m], shape (N, 3).
        v: velocities [m/s], shape (N, 3), or (3,) for a uniform velocity.
        mass: particle masses [kg], shape (N,).
        vol0: particle volumes in the undeformed body [m^3], shape (N,).
        F: elastic deformation gradients, shape (N, 3, 3), by default the identity.
        C: APIC affine velocities [1/s], shape (N, 3, 3), by default zero.
        clamp: index of the clamp that holds each particle, or -1, shape (N,), by default from the positions.
        stuck: tangential displacements since particles stick to a `Collider` [m], shape (N, 3), by default zero.
        F_branch: deformation gradients of the viscous branch of a law, shape (N, 3, 3). None: relaxed.
        stiffness: factors on the stress of the particles, shape (N,), see `neuma_lib.mechanics.fields`. None: 1.
        bodies: number of particles of each body, one after the other. Each of several bodies has its own velocities on
            the grid and touches the others as `body_contact` states. Without bodies all particles are one.

    Raises:
        InputError: shapes, precisions or devices do not match, or a value is not finite or a mass or volume not
            positive.
    """

    x: Tensor
    v: Tensor
    mass: Tensor
    vol0: Tensor
    F: Tensor = None  # type: ignore[assignment]
    C: Tensor = None  # type: ignore[assignment]
    clamp: Tensor | None = None
    stuck: Tensor = None  # type: ignore[assignment]
    F_branch: Tensor | None = None
    bodies: tuple[int, ...] = ()
    stiffness: Tensor | None = None

    def __post_init__(self):
        x = self.x
        if x.ndim != 2 or x.shape[1] != 3 or len(x) == 0:
            raise InputError("state.x", f"shape {tuple(x.shape)} must be (N, 3) with N >= 1")
        if x.dtype not in (torch.float32, torch.float64):
            raise InputError("state.x", f"{x.dtype} must be float32 or float64")
        N = len(x)
        eye = torch.eye(3, dtype=x.dtype, device=x.device).expand(N, 3, 3)
        if self.F is None:
            object.__setattr__(self, "F", eye)
        if self.C is None:
            object.__setattr__(self, "C", torch.zeros_like(eye))
        if self.stuck is None:
            object.__setattr__(self, "stuck", torch.zeros_like(x))
        shapes = {"x": [(N, 3)], "v": [(N, 3), (3,)], "mass": [(N,)], "vol0": [(N,)]}
        shapes |= {"F": [(N, 3, 3)], "C": [(N, 3, 3)], "stuck": [(N, 3)]}
        optional = {"F_branch": [(N, 3, 3)], "stiffness": [(N,)]}
        shapes |= {name: shape for name, shape in optional.items() if getattr(self, name) is not None}
        for name, allowed in shapes.items():
            value = getattr(self, name)
            if tuple(value.shape) not in allowed:
                expected = " or ".join(map(str, allowed))
                raise InputError(f"state.{name}", f"shape {tuple(value.shape)} must be {expected}")
            if value.dtype != x.dtype or value.device != x.device:
                problem = f"{value.dtype} on {value.device} must be {x.dtype} on {x.device}, like x"
                raise InputError(f"state.{name}", problem)
            if not torch.isfinite(value).all():
                raise InputError(f"state.{name}", "a value is not finite")
            if name in ("mass", "vol0", "stiffness") and not (value > 0).all():
                raise InputError(f"state.{name}", f"{float(value.min()):g} must be positive")
        if self.clamp is not None and self.clamp.shape != (N,):
            raise InputError("state.clamp", f"shape {tuple(self.clamp.shape)} must be ({N},)")
        bodies = tuple(self.bodies) if len(self.bodies) > 1 else ()
        if bodies and (len(bodies) > MAX_BODIES or min(bodies) < 1 or sum(bodies) != N):
            raise InputError(
                "state.bodies",
                f"{list(bodies)} must be the numbers of particles of at most {MAX_BODIES} bodies, {N} in all",
            )
        object.__setattr__(self, "bodies", bodies)

    @classmethod
    def rigid(
        cls,
        x: Tensor,
        mass: Tensor,
        vol0: Tensor,
        velocity: Sequence[float] | np.ndarray | Tensor,
        spin: Sequence[float] | np.ndarray | Tensor = (0.0, 0.0, 0.0),
        centre: Sequence[float] | np.ndarray | Tensor | None = None,
    ) -> State:
        """Particles in rigid motion, v = velocity + spin x (x - centre).

        C is the gradient of that field, [spin]_x, which conserves angular momentum on the grid. Without spin the
        velocity is uniform, so that free flight has a closed form.

        Args:
            x, mass, vol0: see `State`.
            velocity: velocity of the centre [m/s], shape (3,).
            spin: angular velocity [rad/s], shape (3,).
            centre: point that moves with `velocity` [m], shape (3,), by default the centre of mass.
        """
        velocity, spin = (torch.as_tensor(vector).to(x) for vector in (velocity, spin))
        if not spin.any():
            return cls(x, velocity, mass, vol0)
        if centre is None:
            centre = mass @ x / mass.sum()
        C = cross_matrix(spin)
        v = velocity + (x - torch.as_tensor(centre).to(x)) @ C.mT
        return cls(x, v, mass, vol0, C=C.expand(len(x), 3, 3))

    @classmethod
    def joined(cls, bodies: Sequence[State], separate: bool = False) -> State:
        """Concatenate the particles of several bodies, as one that sticks where they touch unless ``separate``."""
        x, v, F, C = (torch.cat(parts) for parts in zip(*(body.motion for body in bodies), strict=True))
        mass, vol0, stuck = (
            torch.cat([getattr(body, name) for body in bodies]) for name in ("mass", "vol0", "stuck")
        )
        clamps = [body.clamp for body in bodies if body.clamp is not None]
        if clamps and len(clamps) < len(bodies):
            raise InputError("state.clamp", "must be given for all joined bodies or for none")
        branches = None
        if any(body.F_branch is not None for body in bodies):
            relaxed = torch.eye(3, dtype=x.dtype, device=x.device)
            branches = torch.cat(
                [relaxed.expand_as(body.F) if body.F_branch is None else body.F_branch for body in bodies]
            )
        stiffness = None
        if any(body.stiffness is not None for body in bodies):
            stiffness = torch.cat(
                [torch.ones_like(body.mass) if body.stiffness is None else body.stiffness for body in bodies]
            )
        counts = tuple(len(body.x) for body in bodies) if separate else ()
        held = torch.cat(clamps) if clamps else None
        return cls(x, v, mass, vol0, F, C, held, stuck, branches, counts, stiffness)

    def after(self, path: Trajectory, frame: int = -1) -> State:
        """The state at the frame of this index of a trajectory, from which a simulation continues exactly."""
        more = [name for name in ("stuck", "F_branch") if getattr(path, name) is not None]
        names = ("x", "v", "F", "C", *more)
        return replace(self, **{name: getattr(path, name)[frame] for name in names})

    def to(self, device: torch.device | str) -> State:
        """Copy to another device."""
        moved = {
            name: getattr(self, name).to(device) for name in ("x", "v", "mass", "vol0", "F", "C", "stuck")
        }
        optional = {name: getattr(self, name) for name in ("clamp", "F_branch", "stiffness")}
        given = {name: value.to(device) for name, value in optional.items() if value is not None}
        return State(**moved, **given, bodies=self.bodies)

    @property
    def density(self) -> Tensor:
        """Mass densities of the undeformed particles [kg/m^3], shape (N,)."""
        return self.mass / self.vol0

    @property
    def motion(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The variables of the simulation: x, v (N, 3), F and C."""
        return self.x, self.v.expand_as(self.x), self.F, self.C


def cross_matrix(a: Tensor) -> Tensor:
    """[a]_x, the matrix (3, 3) with [a]_x b = a x b, for a of shape (3,)."""
    return torch.linalg.cross(a.expand(3, 3), torch.eye(3, dtype=a.dtype, device=a.device)).mT


@dataclass(frozen=True)
class Trajectory:
    """States of N particles (and positions of M tracers) at T frames.

    Attributes:
        frames: steps of the frames, increasing, 0 is the initial state.
        x: positions [m], shape (T, N, 3).
        v: velocities [m/s], shape (T, N, 3).
        F: elastic deformation gradients, shape (T, N, 3, 3).
        C: APIC affine velocities [1/s], shape (T, N, 3, 3).
        tracers: positions of passive tracers [m], shape (T, M, 3), or None.
        F_total: total deformation gradients, elastic and plastic, shape (T, N, 3, 3), or None.
        stuck: tangential displacements of particles that stick [m], shape (T, N, 3), None unless particles touch.
        F_branch: deformation gradients of the viscous branch, shape (T, N, 3, 3), None unless a law has one.
    """

    frames: tuple[int, ...]
    x: Tensor
    v: Tensor
    F: Tensor
    C: Tensor
    tracers: Tensor | None = None
    F_total: Tensor | None = None
    stuck: Tensor | None = None
    F_branch: Tensor | None = None

    def at(self, frames: Sequence[int]) -> Trajectory:
        """The states at some of the frames. Frames after the last one repeat it.

        Raises:
            InputError: a frame is missing, or all are after the last one.
        """
        index = {n: i for i, n in reversed(list(enumerate(self.frames)))}
        reached = tuple(n for n in frames if n <= self.frames[-1])
        if not reached or not index.keys() >= set(reached):
            raise InputError("frames", f"{list(frames)} must be frames of the trajectory")
        path = replace(self._each(lambda value: value[[index[n] for n in reached]]), frames=reached)
        return path.hold_last(len(frames) - len(reached)) if len(reached) < len(frames) else path

    def of(self, particles: slice) -> Trajectory:
        """The states of some of the particles, with all tracers."""
        own = self._each(lambda value: value[:, particles])
        return replace(own, tracers=self.tracers)

    def first(self, count: int) -> Trajectory:
        """The states at the first ``count`` frames."""
        return replace(self._each(lambda value: value[:count]), frames=self.frames[:count])

    @property
    def stretch(self) -> Tensor:
        """Deformation of Gaussians, shape (T, N, 3, 3): the total deformation if available, else F."""
        return self.F if self.F_total is None else self.F_total

    def hold_last(self, count: int) -> Trajectory:
        """Repeat the last frame `count` times, for a rollout that stopped early."""
        held = self._each(lambda value: torch.cat([value, value[-1:].expand(count, *value.shape[1:])]))
        return replace(held, frames=self.frames + (self.frames[-1],) * count)

    def arrays(self) -> dict[str, np.ndarray]:
        """What files of rollouts keep: positions and deformation gradients of the particles."""
        values = {"x": self.x, "F": self.F, "F_total": self.F_total}
        return {name: value.cpu().numpy() for name, value in values.items() if value is not None}

    def cpu(self) -> Trajectory:
        """Copy to main memory."""
        return self._each(torch.Tensor.cpu)

    def followed_by(self, second: Trajectory) -> Trajectory:
        """Concatenate this trajectory and a later one with the same parts."""
        joined = {name: torch.cat([value, getattr(second, name)]) for name, value in self._parts().items()}
        return Trajectory(self.frames + second.frames, **joined)

    def split(self, count: int) -> list[Trajectory]:
        """The trajectories of ``count`` copies, see `kernels`."""
        if count == 1:
            return [self]
        return [
            self._each(lambda value, copy=copy: value.unflatten(1, (count, -1))[:, copy].contiguous())
            for copy in range(count)
        ]

    def _each(self, function: Callable[[Tensor], Tensor]) -> Trajectory:
        return replace(self, **{name: function(value) for name, value in self._parts().items()})

    def _parts(self) -> dict[str, Tensor]:
        """The arrays by name, without those that are None."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, Tensor)}
