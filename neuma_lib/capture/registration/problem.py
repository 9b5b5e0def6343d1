"""Least-squares problem of the registration: images of a rigid flight as a function of pose, motion and times."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from neuma_lib.capture.registration.rigid_motion import RigidMotion, rotate
from neuma_lib.capture.registration.rigid_views import LOCAL, Pictures
from neuma_lib.fitting.least_squares import Linearisation

_LIKELY_SPIN = 10.0  # prior standard deviation of the spin of a dropped object [rad/s]
LIKELY_SIZE, ANY_SIZE = 0.01, 0.3
"""Prior standard deviations of the relative size for a known and for an unknown scale."""

TURN, PLACE, VELOCITY, SPIN, SIZE = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), 12
GRAVITY, OFFSETS = slice(13, 16), 16
"""Indices of the unknowns, with those of the offsets from the last one on."""
_ANY_TURN = np.pi / np.sqrt(3)  # standard deviation of a uniform angle [rad]
_UNITS = np.array([_ANY_TURN] * 3 + [0.1] * 3 + [1.0] * 3 + [_LIKELY_SPIN] * 3)
_NO_DIRECTIONS = np.zeros((0, 3))
_GRAVITY_UNIT, _OFFSET_UNIT = 3.0, 0.01  # [m/s^2], [s]


@dataclass(frozen=True, eq=False)
class FittedPose:
    """A pose with its nuisance parameters."""

    motion: RigidMotion  # of the body
    offsets: np.ndarray  # to the times of each camera [s], (cameras,)
    enlargement: float  # of the rendered body, relative
    gains: np.ndarray  # of the cameras, (cameras, 3)
    cost: float = np.inf  # sum of squares in its stage


class Problem:
    """Residuals of images as a function of unknowns in units of `_UNITS`: rotation of the pose, changes of position and
    velocity, spin, enlargement, and changes of gravity and of the offsets of all cameras but the first.

    Attributes:
        size: number of unknowns.
        all: indices of the fitted unknowns.
        start: initial unknowns.
        falling: directions along which gravity is fitted, rows (K, 3), none if it is known.
        central: whether derivatives are central differences, at twice the cost of forward ones.
    """

    def __init__(
        self,
        pictures: Pictures,
        begin: FittedPose,
        time: float,
        fitted: Sequence[int],
        size: float = LIKELY_SIZE,
        falling: np.ndarray = _NO_DIRECTIONS,
        central: bool = False,
    ):
        self.pictures, self.begin, self.time = pictures, begin, time
        self.falling, self.central = falling, central
        cameras = len(begin.offsets)
        self.size = OFFSETS + cameras - 1
        self.units = np.concatenate([_UNITS, [size], [_GRAVITY_UNIT] * 3, np.full(cameras - 1, _OFFSET_UNIT)])
        self.all = [*range(GRAVITY.start + len(falling)), *(OFFSETS + k - 1 for k in fitted)]
        self.start = np.zeros(self.size)
        self.start[SPIN], self.start[SIZE] = begin.motion.spin, begin.enlargement
        self.start /= self.units
        pictures.gains = begin.gains.copy()

    def pose(self, unknowns: np.ndarray) -> FittedPose:
        u, begin = self.units * unknowns, self.begin
        motion = replace(
            begin.motion,
            rotation=Rotation.from_rotvec(u[TURN]).as_matrix() @ begin.motion.rotation,
            centre=begin.motion.centre + u[PLACE],
            velocity=begin.motion.velocity + u[VELOCITY],
            spin=u[SPIN],
            gravity=begin.motion.gravity + u[GRAVITY][: len(self.falling)] @ self.falling,
        )
        offsets = begin.offsets + np.append(0.0, u[OFFSETS:])
        return replace(begin, motion=motion, offsets=offsets, enlargement=float(u[SIZE]))

    def cost(self, unknowns: np.ndarray) -> float:
        """Sum of squares."""
        return float(costs(self.pictures, self.pose(unknowns), self.time).sum())

    def linearise(self, unknowns: np.ndarray, free: Sequence[int], exact: bool = True) -> Linearisation:
        """The problem linearised at unknowns; columns that are not free are 0."""
        pictures, pose = self.pictures, self.pose(unknowns)
        times = picture_times(pictures, pose, self.time)
        motion = pose.motion
        centres, speeds = motion.place(times)
        rotations, spins = motion.turn(times)
        # Derivatives (pictures, 7, unknowns) of the pose in each picture, and of the enlargement.
        G = np.zeros((len(times), LOCAL, self.size))
        G[:, :3, TURN], G[:, :3, SPIN] = self._turns(motion, times)
        G[:, 3:6, PLACE], G[:, 3:6, VELOCITY] = np.eye(3), times[:, None, None] * np.eye(3)
        G[:, 3:6, GRAVITY][..., : len(self.falling)] = times[:, None, None] ** 2 / 2 * self.falling.T
        G[:, 6, SIZE] = 1.0
        for camera in range(1, pictures.cameras):
            of = pictures.camera == camera
            G[of, :3, OFFSETS + camera - 1], G[of, 3:6, OFFSETS + camera - 1] = spins[of], speeds[of]
        held = np.setdiff1d(np.arange(self.size), free)
        G[..., held] = 0.0
        G *= self.units
        H, g, cost = pictures.normal_equations(rotations, centres, pose.enlargement, self.central)
        curvatures = np.einsum("nia,nbij,njc->nbac", G, H, G)
        scores = np.einsum("nia,nbi->nba", G, g)
        # Blocks extend over all pictures of a camera.
        of = np.eye(pictures.cameras)[pictures.camera]
        curvatures, scores = (np.einsum("nc,nb...->cb...", of, each) for each in (curvatures, scores))
        total = float(cost.sum())
        rms = float(np.sqrt(total / pictures.covered))
        curvatures = curvatures.reshape(-1, self.size, self.size)
        return Linearisation(curvatures, scores.reshape(-1, self.size), total, rms)

    def penalty(self, fit: Linearisation) -> np.ndarray:
        """Curvature of the prior 0 +- 1 of rotation, spin and enlargement."""
        curvature = np.zeros(self.size)
        curvature[[*range(3), *range(9, 12), SIZE]] = fit.block_cost
        return np.diag(curvature)

    def _turns(self, motion: RigidMotion, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Difference quotients (T, 3, 3) of the rotations at times by the initial rotation and by the initial spin."""
        step = 1e-4
        changes = step * np.concatenate([np.eye(3), -np.eye(3)])
        turned = Rotation.from_rotvec(changes).as_matrix() @ motion.rotation
        same, spins = (np.repeat(value[None], 6, axis=0) for value in (motion.rotation, motion.spin))
        initial = np.concatenate([turned, same]), np.concatenate([spins, spins + changes])
        rotations, _ = rotate(*initial, motion.inertia, times)
        change = rotations.reshape(2, 2, 3, *rotations.shape[1:])  # (rotation or spin, side, axis, T, 3, 3)
        between = (change[:, 0] @ np.swapaxes(change[:, 1], -1, -2)).reshape(-1, 3, 3)
        rotvecs = Rotation.from_matrix(between).as_rotvec()
        by = rotvecs.reshape(2, 3, len(times), 3).transpose(0, 2, 3, 1) / (2 * step)
        return by[0], by[1]


def picture_times(pictures: Pictures, pose: FittedPose, start: float) -> np.ndarray:
    return pictures.times + pose.offsets[pictures.camera] - start


def render(pictures: Pictures, pose: FittedPose, start: float) -> torch.Tensor:
    times = picture_times(pictures, pose, start)
    poses = pose.motion.turn(times)[0], pose.motion.place(times)[0]
    return pictures.render(*poses, enlargement=pose.enlargement)


def costs(pictures: Pictures, pose: FittedPose, start: float) -> np.ndarray:
    """Cost of each picture, (N,)."""
    return pictures.residuals(render(pictures, pose, start))[1].numpy()


def difference(a: FittedPose, b: FittedPose) -> np.ndarray:
    """Difference b - a of two poses in the unknowns."""
    p, q = a.motion, b.motion
    turn = Rotation.from_matrix(q.rotation @ p.rotation.T).as_rotvec()
    rest = [q.centre - p.centre, q.velocity - p.velocity, q.spin - p.spin, [b.enlargement - a.enlargement]]
    rest.append(q.gravity - p.gravity)
    return np.concatenate([turn, *rest, (b.offsets - a.offsets)[1:]])
