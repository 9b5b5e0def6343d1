"""Rigid obstacles with a signed distance, friction and a prescribed motion."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.sim.motion import Motion, Vector, vector

SIZES = {"plane": (), "box": ("half width", "half height", "half depth"), "sphere": ("radius",)}
SIZES |= {"capsule": ("half length", "radius"), "mesh": ()}
"""Lengths [m] that describe each shape. A plane fills y <= 0, a capsule extends along y, in the frame of the shape."""

CONTACT_STIFFNESS = 0.5
"""Part of a penetration that contact removes in a time step. Any value from 0.1 to 1 is stable on every grid."""


@dataclass(frozen=True, eq=False)
class DistanceGrid:
    """Signed distance to a closed surface at the nodes of a grid, negative inside. Equal if the numbers are.

    Within a cell it is interpolated trilinearly. Outside the grid, whose outer nodes must be outside the surface, a
    point at the distance a from the grid has the distance sqrt(a^2 + d^2), with the interpolated d of the nearest point
    of the grid. That is a lower bound, exact next to a vertex of the surface.
    """

    values: np.ndarray  # distances [m], shape (I, J, K), at least two nodes along an axis
    lowest: Vector  # position of the first node [m]
    spacing: float  # of the nodes [m]
    digest: bytes = field(init=False, repr=False)

    def __post_init__(self):
        values = np.array(self.values, np.float32)
        values.setflags(write=False)
        if values.ndim != 3 or min(values.shape) < 2 or not np.isfinite(values).all():
            raise InputError("distances.values", f"shape {values.shape} must be (I, J, K) with finite values")
        if min(values.take((0, -1), axis).min() for axis in range(3)) <= 0:
            raise InputError("distances.values", "the surface leaves the grid", "Use a larger grid")
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "lowest", vector(self.lowest, "distances.lowest"))
        numbers = np.array([*values.shape, *self.lowest, self.spacing]).tobytes()
        object.__setattr__(self, "digest", hashlib.sha256(numbers + values.tobytes()).digest())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, DistanceGrid) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def at(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """Distance (...,) [m] of points y (..., 3), and the direction (..., 3) of its gradient."""
        values, nodes = torch.from_numpy(self.values.copy()).to(y), y.new_tensor(self.values.shape)
        scaled = (y - y.new_tensor(self.lowest)) / self.spacing
        within = scaled.clamp(torch.zeros_like(nodes), nodes - 1)
        base = torch.minimum(within.detach().floor(), nodes - 2)
        f, base = within - base, base.long()
        distance, slope = 0.0, [0.0, 0.0, 0.0]
        for corner in torch.cartesian_prod(*[torch.arange(2)] * 3).tolist():
            value = values[tuple((base[..., a] + corner[a]) for a in range(3))]
            weights = [f[..., a] if corner[a] else 1 - f[..., a] for a in range(3)]
            distance = distance + weights[0] * weights[1] * weights[2] * value
            for a in range(3):
                rest = weights[a - 1] * weights[a - 2] * value
                slope[a] = slope[a] + (rest if corner[a] else -rest)
        gradient = torch.stack(slope, dim=-1) / self.spacing
        beyond = (scaled - within) * self.spacing
        outside = (beyond != 0).any(dim=-1)
        length = torch.where(outside, (beyond**2).sum(dim=-1) + distance**2, 1.0).sqrt()
        gradient = torch.where(
            outside[..., None], torch.where(beyond != 0, beyond, distance[..., None] * gradient), gradient
        )
        return torch.where(outside, length, distance), gradient / gradient.norm(dim=-1, keepdim=True)


@dataclass(frozen=True)
class Collider(Motion):
    """A rigid obstacle that particles touch.

    A particle of volume V0 is a ball of radius `contact_radius`. Where its gap g to the collider is negative, contact
    changes its velocity v before the transfer to the grid. With the time step dt, the outward normal n and the velocity
    u of the collider at the particle:

        impulse p = max(0, -alpha g / dt - damping n . (v - u)),   alpha = `CONTACT_STIFFNESS`,   v += p n
        friction q = t + alpha s / dt, shortened to at most ``friction`` p,                      v -= q

    Here t is the tangential part of v - u, and s (m) the tangential displacement of the particle since it sticks: a
    spring as stiff as that of the gap. Without it a particle that sticks would creep, because the transfer to the grid
    moves it in every step. s is zero without contact. In slip it keeps the length at which the spring alone has the
    force ``friction`` p.

    Attributes:
        shape: one of `SIZES`.
        size: its lengths [m].
        centre: origin of its frame at t = 0 [m].
        rotation: rotation vector of its frame at t = 0 [rad].
        friction: Coulomb coefficient. Infinity sticks.
        damping: part of the approaching velocity that an impulse removes, 0 (elastic) to 1.
        velocity, spin, keyframes: prescribed motion, see `Motion`.
        distances: of a mesh (`geometry.mesh_collider`), in its frame.

    Raises:
        InputError: a value is out of range or unknown.
    """

    shape: str
    size: tuple[float, ...] = ()
    centre: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)
    friction: float = math.inf
    damping: float = 0.0
    velocity: Vector = (0.0, 0.0, 0.0)
    spin: Vector = (0.0, 0.0, 0.0)
    keyframes: tuple[tuple[float, Vector, Vector], ...] = ()
    distances: DistanceGrid | None = None

    def __post_init__(self):
        if self.shape not in SIZES:
            raise InputError("collider.shape", f"{self.shape!r} must be one of {', '.join(SIZES)}")
        if (self.distances is not None) != (self.shape == "mesh"):
            raise InputError("collider.distances", "must be given for the shape mesh and no other")
        lengths = SIZES[self.shape]
        expected = f"must be positive: {', '.join(lengths) or 'none'} [m]"
        size = vector(self.size, "collider.size", len(lengths), expected)
        if not all(length > 0 for length in size):
            raise InputError("collider.size", f"{self.size!r} {expected}")
        object.__setattr__(self, "size", size)
        self.check_motion("collider")
        if not self.friction >= 0:
            raise InputError("collider.friction", f"{self.friction!r} must be a number of at least 0")
        if not 0 <= self.damping <= 1:
            raise InputError("collider.damping", f"{self.damping!r} must be a number from 0 to 1")

    @staticmethod
    def plane(point: Sequence[float], normal: Sequence[float], **options) -> "Collider":
        """The half-space below a plane through a point [m]; ``normal`` points out of it. Options as for `Collider`."""
        n = torch.tensor(normal, dtype=torch.float64)
        if n.shape != (3,) or not 0 < float(n.norm()) < math.inf:
            raise InputError("collider.normal", f"{normal!r} must be a direction of three finite numbers")
        n = n / n.norm()
        up = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
        axis = torch.linalg.cross(up, n)
        if float(axis.norm()) < 1e-12:  # any axis in the plane turns y to -y
            axis = torch.tensor([math.pi if n[1] < 0 else 0.0, 0.0, 0.0], dtype=torch.float64)
        else:
            axis = axis / axis.norm() * torch.arccos(n[1].clamp(-1, 1))
        return Collider("plane", (), tuple(point), tuple(axis.tolist()), **options)

    def surface(self, x: Tensor, time: float = 0.0) -> tuple[Tensor, Tensor]:
        """Signed distance (...,) [m] of points x (..., 3) to the surface, and outward normal (..., 3)."""
        axes, centre = (value.to(x) for value in self.pose(time))
        y = (x - centre) @ axes
        if self.shape == "plane":
            distance, normal = y[..., 1], torch.tensor([0.0, 1.0, 0.0]).to(x).expand_as(y)
        elif self.shape == "box":
            q = y.abs() - x.new_tensor(self.size)
            deepest = torch.nn.functional.one_hot(q.argmax(dim=-1), 3).to(x)
            beyond = torch.where((q > 0).any(dim=-1, keepdim=True), q.clamp(min=0), deepest)
            length = beyond.norm(dim=-1, keepdim=True)
            distance = torch.where((q > 0).any(dim=-1), length[..., 0], q.amax(dim=-1))
            normal = torch.where(y < 0, -1.0, 1.0) * beyond / length
        elif self.distances is not None:
            distance, normal = self.distances.at(y)
        else:
            half = self.size[0] if self.shape == "capsule" else 0.0
            up = x.new_tensor([0.0, 1.0, 0.0])
            q = y - y[..., 1:2].clamp(-half, half) * up
            length = q.norm(dim=-1, keepdim=True)
            distance, normal = length[..., 0] - self.size[-1], q / length
        return distance, normal @ axes.mT


def contact_radius(vol0: Tensor) -> Tensor:
    """Radius of a particle in contact [m], half the spacing of particles: V0^(1/3) / 2."""
    return 0.5 * vol0.pow(1 / 3)


def unit_cube(frictions: Sequence[float]) -> tuple[Collider, ...]:
    """The faces of the unit cube from within, with a friction each: x_min, x_max, y_min, y_max, z_min, z_max."""
    faces = []
    for wall, friction in enumerate(frictions):
        axis, upper = divmod(wall, 2)
        normal = [0.0, 0.0, 0.0]
        normal[axis] = -1.0 if upper else 1.0
        point = [float(upper and a == axis) for a in range(3)]
        faces.append(Collider.plane(point, normal, friction=friction))
    return tuple(faces)
