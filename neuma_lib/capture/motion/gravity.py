"""Gravity measured in free fall, a joint check of scale, time base and floor.

The centre of mass of any object accelerates at 9.81 m/s^2 straight down, if the board's square size, the frame rate and
the floor are right. A relative error e of the times appears as 2 e.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from neuma_lib.capture.calibration.vertical import UP, Cue
from neuma_lib.config.simulation import GRAVITY
from neuma_lib.errors import InputError

_MAX_MISMATCH = 0.1  # tolerated relative difference between measured and true gravity, as a vector
_UNDECIDED = f"more than {_MAX_MISMATCH:.0%} off, but within its uncertainty: registration measures it again"


@dataclass(frozen=True, eq=False)
class Gravity:
    """The acceleration of a fall."""

    a: np.ndarray  # [m/s^2], (3,)
    covariance: np.ndarray  # (3, 3)
    source: str  # how it was measured, for messages
    several: bool = True  # whether it is from several cameras, which may show different takes
    measured: bool = True  # whether its size is measured. Otherwise a plane of the fall is assumed.

    @property
    def ratio(self) -> tuple[float, float]:
        """|a| / 9.81 and its standard deviation."""
        size = np.linalg.norm(self.a)
        slope = self.a / size
        return float(size / GRAVITY), float(np.sqrt(slope @ self.covariance @ slope) / GRAVITY)

    def angle(self, normal: Sequence[float] = UP) -> tuple[float, float]:
        """Angle between the acceleration and the downward normal of the floor, and its standard deviation [deg]."""
        up = np.asarray(normal, float) / np.linalg.norm(normal)
        size = np.linalg.norm(self.a)
        down = self.a / size
        across = np.eye(3) - np.outer(down, down)
        spread = np.trace(across @ self.covariance @ across) / 2
        angle = np.arctan2(np.linalg.norm(np.cross(down, -up)), -down @ up)
        return float(np.degrees(angle)), float(np.degrees(np.sqrt(spread) / size))

    @property
    def cue(self) -> Cue:
        """The upward direction, against the acceleration."""
        return Cue("gravity in the video", -self.a / np.linalg.norm(self.a), self.angle()[1])

    def describe(self, name: str, normal: Sequence[float] = UP) -> str:
        """One line of text, for the name of the videos and the upward normal (3,) of the floor."""
        return f"{name}: {self._description(normal)}"

    def _description(self, normal: Sequence[float]) -> str:
        (ratio, deviation), (angle, angle_std) = self.ratio, self.angle(normal)
        return (
            f"gravity is {ratio:.3f} +- {deviation:.3f} of {GRAVITY} m/s^2, {angle:.1f} +- {angle_std:.1f}"
            f" degrees from the floor's normal ({self.source})"
        )

    def mismatch(self, normal: Sequence[float] = UP) -> tuple[float, float]:
        """Relative distance from 9.81 m/s^2 against the upward normal (3,), and its standard deviation."""
        up = np.asarray(normal, float) / np.linalg.norm(normal)
        difference = self.a / GRAVITY + up
        size = float(np.linalg.norm(difference))
        slope = difference / max(size, 1e-12)
        return size, float(np.sqrt(slope @ self.covariance @ slope) / GRAVITY)

    def check(self, name: str, normal: Sequence[float] = UP, tolerated: float = 0.0) -> str:
        """Compare with 9.81 m/s^2 straight down and return `describe`.

        Args:
            name: of the videos.
            normal: of the floor, upward, (3,).
            tolerated: standard deviations by which the mismatch may exceed `_MAX_MISMATCH`, above 0 if a more accurate
                measurement follows.

        Raises:
            InputError: the mismatch is larger.
        """
        line, (ratio, _), (angle, _) = self.describe(name, normal), self.ratio, self.angle(normal)
        mismatch, mismatch_std = self.mismatch(normal)
        if mismatch - tolerated * mismatch_std <= _MAX_MISMATCH:
            return line if mismatch <= _MAX_MISMATCH else f"{line}; {_UNDECIDED}"
        causes = []
        if abs(ratio - 1) > _MAX_MISMATCH / 2:
            causes.append(
                f"the board's square size is {1 / ratio:.2f} of the given one, or `length` is (measure it)"
            )
            causes.append(
                f"the frame rate is {ratio**-0.5:.2f} of the assumed one (set the true rate of slow motion)"
            )
            causes.append("the time base is not constant (use the original file of the camera)")
            causes.append("the camera reads its rows one after the other (set `row_time`)")
        if angle > np.degrees(_MAX_MISMATCH / 2):
            causes.append("the floor or board is not level, or the camera moved after its pose was estimated")
        if self.several:
            causes.append("the videos show different takes or objects")
        causes.append("the frames of free flight include contact, or a hand that holds the object")
        raise InputError(name, self._description(normal), f"Likely causes: {'; '.join(causes)}")

    def known_length(self, places: Mapping[str, Sequence[float]], name: str) -> InputError:
        """An error that states the length in metres which gravity gives to a room whose unit is unknown.

        Args:
            places: centres of the cameras of photographs in the room, (3,) each, by file name.
            name: of the videos.
        """
        if not self.measured:
            remedy = (
                "One camera measures it only if it sees the contact with the floor from above. Film that, film with a"
                " second camera, or state a length (`length`)"
            )
            return InputError(name, "the scale is unknown, there is neither a board nor a length", remedy)
        files, centres = list(places), np.array(list(places.values()))
        distances = np.linalg.norm(centres[:, None] - centres, axis=-1)
        a, b = np.unravel_index(distances.argmax(), distances.shape)
        ratio, deviation = self.ratio
        metres = float(distances[a, b] / ratio)
        spread = metres * deviation / ratio
        return InputError(
            name,
            f"the scale is unknown. Gravity in the video ({self.source}) gives {metres:.4g} +- {spread:.2g} m between"
            f" the cameras of {files[a]} and {files[b]}",
            "Check on the contact sheets that times and frame rate are right, and write into capture.yaml: length:"
            f" {{metres: {metres:.4g}, deviation: {spread:.2g}, cameras: [{files[a]}, {files[b]}]}}",
        )

    def report(self) -> dict[str, Any]:
        """JSON report. Metres of the room, y up."""
        (ratio, deviation), (angle, angle_std) = self.ratio, self.angle()
        return {
            "gravity_m_s2": self.a.tolist(),
            "gravity_ratio": ratio,
            "gravity_ratio_deviation": deviation,
            "gravity_angle_deg": angle,
            "gravity_angle_deviation_deg": angle_std,
        }
