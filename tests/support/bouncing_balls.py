"""Silhouettes of balls whose contact with the floor follows Hertz, and their free flights."""

import numpy as np
from scipy.integrate import solve_ivp

from neuma_lib.capture.motion.bounce import Rise

GRAVITY = 9.81


def hertz_motion(times, radius, fall, stiffness, restitution=1.0):
    """Height above the floor [m] and velocity [m/s] of the centre of a ball, released ``fall`` above it at time 0.

    m y'' = -m g + 4/3 E* sqrt(R) d^(3/2) with m = 4/3 pi R^3 density and ``stiffness`` = E* / density. The force of the
    way up is smaller by restitution^2, so the ball leaves with this share of its speed.
    """
    constant = stiffness / np.pi / radius**2.5

    def rates(_, state):
        depth = max(radius - state[0], 0.0)
        share = restitution**2 if state[1] > 0 else 1.0
        return [state[1], -GRAVITY + share * constant * depth**1.5]

    start = [radius + fall, 0.0]
    return solve_ivp(rates, (0, times[-1]), start, t_eval=times, max_step=2e-4, rtol=1e-8).y


def cut_disc(centre, radius, floor, shape):
    """Mask of a disc (x, y) [px] that ends at the row of the floor."""
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    return ((x - centre[0]) ** 2 + (y - centre[1]) ** 2 <= radius**2) & (y < floor)


def rise(times, masks, frames):
    """The parabola through the centroids of some masks."""
    t = times[frames] - times[frames[0]]
    heights = [-(np.nonzero(masks[k])[0].mean() + 0.5) for k in frames]
    basis = np.diag([0.5, 1.0, 1.0])
    mean, covariance = np.polyfit(t, heights, 2, cov=True)
    turn = np.linalg.inv(basis)[::-1]  # of (a / 2, v, h) to (h, v, a)
    return Rise(float(times[frames[0]]), turn @ mean, turn @ covariance @ turn.T)
