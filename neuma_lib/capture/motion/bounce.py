"""Restitution, duration of contact and stiffness of a ball that bounces off a level floor, from one camera.

The silhouettes in contact show the floor. The centre is one radius above it at the first and at the last instant of
contact. The parabolas of both flights give these instants, below the time between frames. Hertz (1881) relates the
duration T to the stiffness of a solid elastic sphere of radius R on a rigid plane: with the speeds v1 and v2 before and
after contact, the flattening is d = T / (I / v1 + I / v2) and E / (1 - nu^2) / density = 5 pi / 4 v^2 (R / d)^(5/2),
where I is the integral of (1 - x^(5/2))^(-1/2) from 0 to 1. With losses, v lies between v2 and v1, which is part of the
uncertainty. Heights are -y of the picture [px].
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.special import beta

from neuma_lib.capture.masks.regions import centroid, radius_of, whole

HALF_CONTACT = 0.4 * float(beta(0.4, 0.5))
"""Time until the largest flattening, of flattening / speed: the integral I."""
MIN_RADIUS = 5.0  # radius of a silhouette from which its lowest point is measured [px]
_SAMPLES = 4000
_BAND = (2.5, 50.0, 97.5)  # percentiles
_MIDDLE = 0.4  # half the width of the middle part of a silhouette, in radii
_SEEN = 3.0  # standard deviations by which the floor must stop a silhouette
_MIN_SPREAD = 0.1  # standard deviation of the ends of a silhouette, at least [px]
_FLAT = 12**-0.5  # standard deviation of a horizontal edge, all of whose pixels are rounded alike [px]


class Rise(NamedTuple):
    """Height h + v t + a t^2 / 2 of the centre in free flight, with t relative to ``start`` [px, s]."""

    start: float
    mean: np.ndarray  # h, v, a: (3,)
    covariance: np.ndarray  # (3, 3)

    def state(self, times: np.ndarray, samples: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Height [px] and velocity [px/s] at times [s], of the mean or of samples (S, 3)."""
        t, (h, v, a) = times - self.start, self.mean if samples is None else samples.T
        return h + v * t + a * t**2 / 2, v + a * t


def ends(mask: np.ndarray) -> tuple[float, float]:
    """Heights of the lowest and the highest point of a silhouette on the vertical through its centroid [px].

    Parabolas through the edges of the middle columns average the pixels.
    """
    x, half = centroid(mask)[0], max(2.0, _MIDDLE * radius_of(mask))
    columns = np.flatnonzero(mask.any(axis=0) & (np.abs(np.arange(mask.shape[1]) + 0.5 - x) < half))
    edges = len(mask) - mask[::-1, columns].argmax(axis=0), mask[:, columns].argmax(axis=0)
    low, high = (float(np.polyfit(columns + 0.5 - x, -edge, 2)[2]) for edge in edges)
    return low, high


def measure_bounce(
    flights: Sequence[Rise],
    flying: Sequence[np.ndarray],
    masks: np.ndarray,
    times: np.ndarray,
    scale: float,
    deviation: float,
) -> dict[str, Any] | None:
    """Measure the contact between two flights of a ball. Bands are the 2.5th, 50th and 97.5th percentile.

    The duration has only an upper limit, and the stiffness a lower one, if no frame shows the contact, if a frame is
    exposed for longer, or if it is not known to a factor of two.

    Args:
        flights: before and after contact.
        flying: indices of their frames among the masks.
        masks: silhouettes (T, H, W), empty where the ball is not visible.
        times: of the frames [s], (T,).
        scale, deviation: length of a pixel [m], and its relative standard deviation.

    Returns:
        JSON report. None if the ball is too small, or the flights do not meet.
    """
    rng = np.random.default_rng(0)
    before, after = flights
    first, second = (rng.multivariate_normal(r.mean, r.covariance, _SAMPLES) for r in flights)
    halves = np.array([-centroid(masks[k])[1] - ends(masks[k])[0] for k in np.concatenate(flying)])
    speeds = np.concatenate([np.abs(r.state(times[k])[1]) for r, k in zip(flights, flying)])
    # Blur adds half of the path during the exposure to the lower half of a silhouette.
    design = np.stack([np.ones_like(speeds), speeds / 2], axis=1)
    radius, exposure = map(float, np.linalg.lstsq(design, halves, rcond=None)[0])
    spread = max(float(np.std(halves - design @ (radius, exposure), ddof=2)), _MIN_SPREAD)
    radius_spread = spread * np.sqrt(np.linalg.inv(design.T @ design)[0, 0])
    near = [k for k in range(flying[0][-1], flying[1][0] + 1) if whole(masks[k])]  # the border is no floor
    if radius < MIN_RADIUS or not near:
        return None
    low, high = np.array([ends(masks[k]) for k in near]).T
    free = np.maximum(*(r.state(times[near])[0] for r in flights)) - radius
    contact = (low > free + _SEEN * spread) & ~np.isin(near, np.concatenate(flying))
    seen = bool(contact.any())
    flattening = max(0.0, *(2 * radius - high + low)[contact]) if seen else 0.0
    floor = float(np.median(low[contact]) if seen else low.min())
    touch = floor + rng.normal(radius, np.linalg.norm([spread, _FLAT, radius_spread]), _SAMPLES)
    with np.errstate(invalid="ignore"):
        down, up = (np.sqrt(s[:, 1] ** 2 + 2 * s[:, 2] * (touch - s[:, 0])) for s in (first, second))
    instants = (-down - first[:, 1]) / first[:, 2], (up - second[:, 1]) / second[:, 2]
    duration = instants[1] + after.start - instants[0] - before.start
    meeting = np.full(_SAMPLES, after.start)  # of the parabolas, by Newton's method
    (h1, v1), (h2, v2) = before.state(meeting, first), after.state(meeting, second)
    for _ in range(8):
        meeting = meeting - (h1 - h2) / (v1 - v2)
        (h1, v1), (h2, v2) = before.state(meeting, first), after.state(meeting, second)
    ratio = up / down if seen else -v2 / v1
    good = np.isfinite(duration) & (ratio > 0) & (v1 < 0)
    if good.mean() < 0.9:
        return None
    relative = duration / (HALF_CONTACT / down + HALF_CONTACT / up) / (touch - floor)
    squared = scale**2 * down * up * np.exp(rng.uniform(-1, 1, _SAMPLES) * np.log(np.abs(ratio)))
    squared *= np.exp(2 * deviation * rng.normal(size=_SAMPLES))
    stiffness = 5 * np.pi / 4 * squared * np.maximum(relative, 1e-9) ** -2.5
    bands = (np.percentile(each[good], _BAND).tolist() for each in (ratio, duration, relative, stiffness))
    restitution, duration, relative, stiffness = bands
    if not seen or duration[0] <= max(duration[1] / 2, exposure):
        duration[:2], relative[:2], stiffness[1:] = [None] * 2, [None] * 2, [None] * 2
    return {
        "radius_px": radius,
        "floor_px": floor,
        "exposure_s": max(0.0, exposure),
        "frames_of_contact": int(contact.sum()),
        "largest_flattening_seen_m": scale * float(flattening) or None,  # blur hides it
        "restitution_band": restitution,
        "contact_s_band": duration,
        "flattening_of_radius_band": relative,
        "modulus_per_density_m2_s2_band": stiffness,
    }
