"""The upward direction of a room, from several independent cues that must agree.

A floor, a board and the orientation of a hand-held camera each fail in their own way: the largest plane may be a wall,
a board may lean, and the orientation sensor of a phone that is held flat reports a quarter turn. A single cue that is
wrong turns the whole simulation, so the cues are compared before anything else uses the direction.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from neuma_lib.capture.pictures import QUARTER_TURNS
from neuma_lib.errors import InputError

UP = (0.0, 1.0, 0.0)  # upward direction of the room
MAX_ANGLE = 15.0  # angle between two cues above which at least one of them is wrong [degrees]
ROLL = 5.0  # standard deviation of the roll of a hand-held camera [degrees]
_DEVIATIONS = 2.0  # standard deviations by which an angle must exceed the limit
_ROUNDS = 5  # of direction and quarter turns in turn


@dataclass(frozen=True, eq=False)
class Cue:
    """An estimate of the upward direction."""

    name: str  # its source, for messages
    up: np.ndarray  # unit vector (3,)
    deviation: float = 0.0  # standard deviation about the worst axis [degrees]

    def angle(self, other: "Cue") -> float:
        """Angle to another cue [degrees]."""
        return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(self.up, other.up)), self.up @ other.up)))

    def plain(self) -> dict[str, Any]:
        """Entries of a report, read by `read_cues`."""
        return {"name": self.name, "up": self.up.tolist(), "deviation_deg": self.deviation}


def read_cues(values: Sequence[dict[str, Any]]) -> list[Cue]:
    """Cues of a report."""
    return [Cue(each["name"], np.array(each["up"]), each["deviation_deg"]) for each in values]


def camera_cues(viewmats: np.ndarray, orientations: Sequence[int | None]) -> list[Cue]:
    """Cues from the way in which photographs were held.

    The horizontal axis of an upright picture is level, up to the roll of the hand, wherever the camera points. The
    vertical direction is perpendicular to these axes of all photographs. "cameras" chooses for each photograph the
    quarter turn that agrees with the others. "EXIF orientation" trusts the orientation sensor of the phone.

    Args:
        viewmats: world to camera of the photographs in sensor orientation, OpenCV axes, (N, 4, 4).
        orientations: EXIF orientation of each, None without one, (N,).
    """
    turns = np.array([QUARTER_TURNS.get(o or 1, 0) for o in orientations], int)
    stated = np.array([o in QUARTER_TURNS for o in orientations], bool)
    axes = np.stack([_upright_axes(viewmats, quarter) for quarter in range(4)])  # (4, N, 2, 3)
    every = np.arange(len(viewmats))
    cues = []
    if stated.sum() > 1 and (cue := _level(axes[turns[stated], every[stated]], "EXIF orientation")):
        cues.append(cue)
    for _ in range(_ROUNDS):
        if len(viewmats) < 2 or (cue := _level(axes[turns, every], "cameras")) is None:
            return cues
        best = (axes[:, :, 1] @ cue.up).argmax(axis=0)
        if (best == turns).all():
            break
        turns = best
    return [cue, *cues]


def _upright_axes(viewmats: np.ndarray, quarter: int) -> np.ndarray:
    """Axes to the right and up, (N, 2, 3), of pictures after clockwise quarter turns."""
    right, down = viewmats[:, 0, :3], viewmats[:, 1, :3]
    ordered = [(right, -down), (-down, -right), (-right, down), (down, right)][quarter]
    return np.stack(ordered, axis=1)


def _level(axes: np.ndarray, name: str) -> Cue | None:
    """The direction perpendicular to axes to the right, given with the axes up, (N, 2, 3). None if undetermined."""
    values, vectors = np.linalg.eigh(np.einsum("ni,nj->ij", axes[:, 0], axes[:, 0]))
    up = vectors[:, 0] * np.sign(axes[:, 1].mean(axis=0) @ vectors[:, 0])
    if not up.any():
        return None
    roll = max(np.sqrt(values[0] / len(axes)), np.sin(np.radians(ROLL)))
    return Cue(name, up, float(np.degrees(min(roll / np.sqrt(max(values[1], 1e-12)), np.pi))))


def check_vertical(cues: Sequence[Cue], where: str) -> str:
    """Compare all pairs of cues, and return their angles to the first one as a line of text.

    Raises:
        InputError: two cues differ by more than `MAX_ANGLE` and two standard deviations. It lists all angles.
    """
    angles = {(a.name, b.name): a.angle(b) for a, b in combinations(cues, 2)}
    contradictory = [
        (a, b)
        for a, b in combinations(cues, 2)
        if a.angle(b) - _DEVIATIONS * np.hypot(a.deviation, b.deviation) > MAX_ANGLE
    ]
    if contradictory:
        listed = ", ".join(f"{a} and {b} {angle:.0f} degrees" for (a, b), angle in angles.items())
        odd = max(
            (cue for pair in contradictory for cue in pair),
            key=lambda c: sum(c in pair for pair in contradictory),
        )
        alone = sum(odd in pair for pair in contradictory) > 1 or len(cues) == 2
        raise InputError(
            where,
            f"estimates of the upward direction differ by more than {MAX_ANGLE:.0f} degrees ({listed})"
            + (f"; {odd.name} differs from most others" if alone and len(cues) > 2 else ""),
            "Lay the printed board on the floor. Or hold the camera level, walk all around the object, and photograph"
            " more of the textured surface that it stands on",
        )
    first = cues[0]
    others = ", ".join(f"{c.name} {first.angle(c):.1f} +- {c.deviation:.1f} degrees" for c in cues[1:])
    return f"upward direction from {first.name}" + (f"; from it, {others}" if others else "")
