"""Tracks of markers on a body, as motion capture records them."""

from dataclasses import dataclass

import numpy as np

from neuma_lib.errors import InputError

_STILL = 0.05
"""Share of the largest displacement up to which markers count as not released, more than the noise of a record."""


@dataclass(frozen=True)
class MarkerTracks:
    """Positions of M markers at T times.

    Attributes:
        times: [s], increasing, shape (T,).
        positions: [m], shape (T, M, 3).

    Raises:
        InputError: shapes do not match, fewer than four frames, or times that do not increase.
    """

    times: np.ndarray
    positions: np.ndarray

    def __post_init__(self):
        T = len(self.times)
        if T < 4 or self.positions.ndim != 3 or self.positions.shape[::2] != (T, 3):
            given = f"{T} times and positions of shape {self.positions.shape}"
            raise InputError("markers", f"{given} must be at least 4 frames of (T, M, 3)")
        if not (np.diff(self.times) > 0).all():
            raise InputError("markers", "times must increase")

    def turned(self, along: str, up: str) -> "MarkerTracks":
        """The same in axes x along the beam, y up and z to the right, of which two are named in those of the file.

        Args:
            along, up: "x", "y" or "z", with "-" before it for the opposite direction.
        """
        axes = np.zeros((3, 3))
        for row, name in enumerate((along, up)):
            axes[row, "xyz".index(name[-1])] = -1.0 if name.startswith("-") else 1.0
        axes[2] = np.cross(axes[0], axes[1])
        return MarkerTracks(self.times, self.positions @ axes.T)

    def release(self) -> float:
        """Time of the last frame before the markers move [s], that is before they move by half of what they do."""
        centre = self.positions.mean(1)
        moved = np.linalg.norm(centre - centre[0], axis=1)
        half = int((moved > 0.5 * moved.max()).argmax())
        still = np.flatnonzero(moved[: half + 1] <= _STILL * moved.max())
        return float(self.times[still[-1]])

    def before(self, release: float) -> np.ndarray:
        """Mean positions [m] of the frames up to a time [s], shape (M, 3)."""
        return self.positions[: max(int((self.times <= release).sum()), 1)].mean(0)

    def within(self, first: float, last: float) -> "MarkerTracks":
        """The frames of an interval of times [s]."""
        keep = (self.times >= first) & (self.times <= last)
        return MarkerTracks(self.times[keep], self.positions[keep])
