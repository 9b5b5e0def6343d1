"""Gravity as a fall shows it: the check of scale, time base and floor together.

Whatever the object is, its centre of mass falls with 9.81 m/s^2 straight down. With that the squares of the board, the
frame rate and the floor are right; times that are off by a part e show as 2 e.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from neuma_lib.config.simulation import GRAVITY
from neuma_lib.errors import InputError

UP = (0.0, 1.0, 0.0)
"""The floor's normal in the room."""
MOST_MISMATCH = 0.1
"""Part by which the measured gravity may differ from the true one, as a vector."""
_UNDECIDED = f"more than {MOST_MISMATCH:.0%} off, but not surely: the placed object will tell"


@dataclass(frozen=True, eq=False)
class Gravity:
    """The acceleration of a fall.

    Attributes:
        a: [m/s^2], (3,).
        covariance: (3, 3).
        how: it was measured, for people.
        several: whether cameras that could show different throws were compared.
    """

    a: np.ndarray
    covariance: np.ndarray
    how: str
    several: bool = True

    @property
    def ratio(self) -> tuple[float, float]:
        """|a| / 9.81 and its deviation."""
        size = np.linalg.norm(self.a)
        slope = self.a / size
        return float(size / GRAVITY), float(np.sqrt(slope @ self.covariance @ slope) / GRAVITY)

    def angle(self, normal: Sequence[float] = UP) -> tuple[float, float]:
        """Angle between the acceleration and straight down, and its deviation (root mean square of both ways) [deg].

        Args:
            normal: of the floor, upward, (3,).
        """
        up = np.asarray(normal, float) / np.linalg.norm(normal)
        size = np.linalg.norm(self.a)
        down = self.a / size
        across = np.eye(3) - np.outer(down, down)
        spread = np.trace(across @ self.covariance @ across) / 2
        angle = np.arctan2(np.linalg.norm(np.cross(down, -up)), -down @ up)
        return float(np.degrees(angle)), float(np.degrees(np.sqrt(spread) / size))

    def told(self, name: str, normal: Sequence[float] = UP) -> str:
        """A line for people.

        Args:
            name: of the videos.
            normal: of the floor, upward, (3,).
        """
        (ratio, deviation), (angle, unsure) = self.ratio, self.angle(normal)
        return (
            f"{name}: gravity is {ratio:.3f} +- {deviation:.3f} of {GRAVITY} m/s^2, {angle:.1f} +- {unsure:.1f}"
            f" degrees from the floor's normal ({self.how})"
        )

    def mismatch(self, normal: Sequence[float] = UP) -> tuple[float, float]:
        """Distance from 9.81 m/s^2 straight down as a part of that, and its deviation.

        Args:
            normal: of the floor, upward, (3,).
        """
        up = np.asarray(normal, float) / np.linalg.norm(normal)
        off = self.a / GRAVITY + up
        size = float(np.linalg.norm(off))
        slope = off / max(size, 1e-12)
        return size, float(np.sqrt(slope @ self.covariance @ slope) / GRAVITY)

    def checked(self, name: str, normal: Sequence[float] = UP, doubt: float = 0.0) -> str:
        """The line of `told`.

        Args:
            name: of the videos.
            normal: of the floor, upward, (3,).
            doubt: how many of its deviations a mismatch has to be beyond the bound: above 0 where a better measurement
                follows, which decides.

        Raises:
            InputError: the acceleration differs from 9.81 m/s^2 downward by more than `MOST_MISMATCH`, as a vector.
        """
        line, (ratio, _), (angle, _) = self.told(name, normal), self.ratio, self.angle(normal)
        mismatch, unsure = self.mismatch(normal)
        if mismatch - doubt * unsure <= MOST_MISMATCH:
            return line if mismatch <= MOST_MISMATCH else f"{line}; {_UNDECIDED}"
        causes = []
        if abs(ratio - 1) > MOST_MISMATCH / 2:
            causes.append(f"the board's square size is {1 / ratio:.2f} of what is stated (measure it)")
            causes.append(
                f"the frame rate is {ratio**-0.5:.2f} of what is assumed (slow motion: state the true rate)"
            )
            causes.append("the time base is not steady (take the file as the camera wrote it)")
        if angle > np.degrees(MOST_MISMATCH / 2):
            causes.append("the floor or board is not level, or the camera has moved since its pose was taken")
        if self.several:
            causes.append("the videos are of different throws or objects")
        causes.append(
            "frames after contact, or while a hand still holds the object, are among those of free flight"
        )
        raise InputError(f"{line}. Likely causes: {'; '.join(causes)}")

    def report(self) -> dict[str, Any]:
        """For JSON; the room's metres, y up."""
        (ratio, deviation), (angle, unsure) = self.ratio, self.angle()
        return {
            "gravity_m_s2": self.a.tolist(),
            "gravity_ratio": ratio,
            "gravity_ratio_deviation": deviation,
            "gravity_angle_deg": angle,
            "gravity_angle_deviation_deg": unsure,
        }


def gravity_checks(name: str, found: Mapping[str, Any]) -> list[tuple[str, str, str, bool]]:
    """Checks of a `Gravity.report`: what, found, wanted, good."""
    ratio, spread = found["gravity_ratio"], found["gravity_ratio_deviation"]
    angle, unsure = found["gravity_angle_deg"], found["gravity_angle_deviation_deg"]
    return [
        (
            f"gravity in {name}",
            f"{ratio:.3f} +- {spread:.3f} of {GRAVITY} m/s^2",
            "1 +- 0.03",
            abs(ratio - 1) < 0.03 + 2 * spread,
        ),
        (
            f"down in {name}",
            f"{angle:.1f} +- {unsure:.1f} degrees off the floor's normal",
            "< 1.5 degrees",
            angle < 1.5 + 2 * unsure,
        ),
    ]
