"""Free flight of a rigid body, with a parabola of its centre and constant angular momentum."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

_MAX_ANGLE = 0.1  # maximum rotation angle per integration step, whose error is of fifth order [rad]


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """A free flight, x(t) = R(t) (x_photo - pivot) + c(t)."""

    rotation: np.ndarray  # R(0), from the photographed body to the world, (3, 3)
    centre: np.ndarray  # c(0), centre of mass [m], (3,)
    velocity: np.ndarray  # initial velocity of the centre [m/s], (3,)
    spin: np.ndarray  # initial angular velocity in the world [rad/s], (3,)
    gravity: np.ndarray  # gravity [m/s^2], (3,)
    # moment of inertia per mass of the photographed body about its centre of mass [m^2], (3, 3)
    inertia: np.ndarray

    def place(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centre (T, 3) [m] and its velocity (T, 3) [m/s] at times (T,) [s]."""
        t = np.asarray(times, float)[:, None]
        return self.centre + self.velocity * t + self.gravity * t**2 / 2, self.velocity + self.gravity * t

    def turn(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (T, 3, 3) and angular velocities (T, 3) [rad/s] at times (T,) [s]."""
        R, w = rotate(self.rotation[None], self.spin[None], self.inertia, times)
        return R[0], w[0]


def rotate(
    rotations: np.ndarray, spins: np.ndarray, inertia: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (B, T, 3, 3) and angular velocities (B, T, 3) of B free bodies at times (T,) of any sign.

    dR/dt = [omega]_x R, omega = R J^-1 R^T L with constant angular momentum L, by the fourth-order Runge-Kutta method.

    Args:
        rotations, spins: initial values, (B, 3, 3) and (B, 3) [rad/s].
        inertia: J of the body at R = 1, (3, 3), in any unit.
    """
    times, inverse = np.asarray(times, float), np.linalg.inv(inertia)
    momentum = np.einsum("bij,jk,blk,bl->bi", rotations, inertia, rotations, spins)
    fastest = np.linalg.norm(spins, axis=1).max()

    def rate(R):
        return np.einsum("bij,jk,blk,bl->bi", R, inverse, R, momentum)

    def slope(R):
        return np.cross(rate(R)[:, :, None], R, axis=1)

    rotations_at = np.empty((len(rotations), len(times), 3, 3))
    speeds = np.empty((len(rotations), len(times), 3))
    for side in (1, -1):
        R, now = rotations, 0.0
        for i in np.argsort(side * times, kind="stable"):
            if side * times[i] < 0 or (side < 0 and times[i] == 0):
                continue
            steps = max(1, int(np.ceil(abs(times[i] - now) * fastest / _MAX_ANGLE)))
            h = (times[i] - now) / steps
            for _ in range(steps if h else 0):
                k1 = slope(R)
                k2 = slope(R + h / 2 * k1)
                k3 = slope(R + h / 2 * k2)
                R = R + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(R + h * k3))
            now, rotations_at[:, i], speeds[:, i] = times[i], R, rate(R)
    U, _, Vt = np.linalg.svd(rotations_at)
    return U @ Vt, speeds


def moment_of_inertia(arms: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """Moment of inertia per mass (3, 3) [m^2] of points at arms (N, 3) [m] from their centre of mass."""
    second = np.einsum("n,ni,nj->ij", mass / mass.sum(), arms, arms)
    return np.trace(second) * np.eye(3) - second


def spread_rotations(count: int) -> np.ndarray:
    """Evenly distributed rotations (count, 3, 3): super-Fibonacci spirals (Alexa, CVPR 2022).

    Every rotation is within about 3.5 count^(-1/3) rad of one of them.
    """
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    a, b = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / 1.533751168755204288118041
    quats = np.stack([inner * np.sin(a), inner * np.cos(a), outer * np.sin(b), outer * np.cos(b)], axis=1)
    return Rotation.from_quat(quats).as_matrix()


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles [rad] between rotations (..., 3, 3)."""
    return Rotation.from_matrix((a @ np.swapaxes(b, -1, -2)).reshape(-1, 3, 3)).magnitude()
