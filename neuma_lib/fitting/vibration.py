"""Frequency and damping of a vibration that dies away."""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares


@dataclass(frozen=True)
class Vibration:
    """x(t) = rest + amplitude exp(-damping w t) cos(w t + phase) with w = 2 pi frequency."""

    # rest, amplitude: in the unit of x
    rest: float
    amplitude: float
    frequency: float  # [Hz]
    damping: float  # ratio of the decay rate to w
    phase: float  # [rad]


def fit_vibration(times: np.ndarray, values: np.ndarray) -> Vibration:
    """Least-squares fit to values (T,) at times (T,) [s], which contain at least two periods."""
    t = times - times[0]
    rest = float(values[len(values) // 2 :].mean())
    spectrum = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(len(values))))
    step = float(np.diff(t).mean())
    guess = np.fft.rfftfreq(len(values), step)[max(1, int(spectrum.argmax()))]
    size = float(np.abs(values - rest).max())

    def residual(p: np.ndarray) -> np.ndarray:
        w = 2 * math.pi * p[3]
        decay = np.exp(-p[4] * w * t)
        return p[0] + decay * (p[1] * np.cos(w * t) + p[2] * np.sin(w * t)) - values

    scale = np.array([size, size, size, guess, 0.05])
    starts = [
        np.array([rest, size * math.cos(phase), size * math.sin(phase), guess * factor, 0.03])
        for factor in (0.9, 1.0, 1.1)
        for phase in (0.0, 0.5 * math.pi, math.pi, 1.5 * math.pi)
    ]
    fits = [least_squares(residual, start, x_scale=scale) for start in starts]
    c, a, b, frequency, damping = min(fits, key=lambda fit: fit.cost).x
    return Vibration(c, math.hypot(a, b), frequency, damping, math.atan2(-b, a))
