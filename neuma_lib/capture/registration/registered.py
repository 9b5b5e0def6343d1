"""A photographed object as it was placed into its video: what is known of its pose and motion, and what is not told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from neuma_lib.capture.registration.problem import OFFSETS, PLACE, SIZE, SPIN, TURN, VELOCITY, Found
from neuma_lib.capture.registration.rigid_views import Shown

CLEAR_MARGIN = 0.25
"""Part of its cost by which the next distinct pose must be worse than the best one to be told from it: two standard
deviations if the residuals of a block of the picture count as one (`Linearisation.block_cost`)."""
CLEAR_ANGLE = 10.0
"""Largest standard deviation of a rotation [degrees] that is known."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """How a pose looks like what was seen, each of shape (pictures,).

    Attributes:
        camera: number of each picture's camera.
        iou: of mask and rendered outline.
        off: distance of their centroids, in pixels of the video.
        rms: root mean square of the residual of colours and coverage over the mask.
    """

    camera: np.ndarray
    iou: np.ndarray
    off: np.ndarray
    rms: np.ndarray


@dataclass(frozen=True, eq=False)
class Registration:
    """A photographed object placed into its video, x_video = s R x_photo + t at the time `start`.

    Attributes:
        names: of the cameras.
        start: the first frame of the flight that all cameras saw, by the first camera's clock [s].
        pivot: the centre of mass as photographed [m], (3,).
        scale_known: whether the photographs are in metres of the video, s = 1.
        found: pose and motion.
        covariance: of a turn about the world's axes [rad], the centre [m], velocity [m/s], spin [rad/s], enlargement,
            gravity [m/s^2] and the offsets of the cameras but the first [s], (15 + cameras,) squared; 0 for what was
            stated, as gravity is.
        gravity, gravity_covariance: the acceleration that the pictures show where it is fitted along [m/s^2], (3,) and
            (3, 3).
        before, after: agreement of the object as photographed, where the masks' centres are, and as placed.
        rival: cost of the next distinct pose relative to the best one's, and the angle between the two [degrees]; None:
            no other was left.
        spin_told: whether the spin is told from 0; it is 0 otherwise.
        pictures: number of pictures that were compared at last, and the size of a side of them [px].
        axes: rows are the first camera's right, down and viewing direction, (3, 3).
        shown: some pictures of each camera beside their renders.
    """

    names: tuple[str, ...]
    start: float
    pivot: np.ndarray
    scale_known: bool
    found: Found
    covariance: np.ndarray
    gravity: np.ndarray
    gravity_covariance: np.ndarray
    before: Agreement
    after: Agreement
    rival: tuple[float, float] | None
    spin_told: bool
    pictures: tuple[int, int]
    axes: np.ndarray
    shown: list[Shown]

    @property
    def rotation(self) -> np.ndarray:
        return self.found.motion.rotation

    @property
    def scale(self) -> float:
        return 1.0 if self.scale_known else 1.0 + self.found.enlargement

    @property
    def translation(self) -> np.ndarray:
        return self.found.motion.centre - self.scale * self.rotation @ self.pivot

    def place(self, x: np.ndarray) -> np.ndarray:
        """Points (N, 3) [m] of the object as photographed, in the video at the time `start`."""
        return self.scale * x @ self.rotation.T + self.translation

    @property
    def turn_deviations(self) -> np.ndarray:
        """Standard deviations of the rotation about its best and worst known axes [degrees], ascending, (3,)."""
        return np.degrees(np.sqrt(np.maximum(np.linalg.eigvalsh(self.covariance[TURN, TURN]), 0)))

    @property
    def ambiguous(self) -> str:
        """What is not told about the pose; nothing if all is."""
        said = []
        worst = self.turn_deviations[-1]
        if worst > CLEAR_ANGLE:
            values, vectors = np.linalg.eigh(self.covariance[TURN, TURN])
            count = int((np.degrees(np.sqrt(np.maximum(values, 0))) > CLEAR_ANGLE).sum())
            axis = ", ".join(f"{x:.2f}" for x in vectors[:, -1])
            about = (
                f"about the axis ({axis})" if count == 1 else f"about {('two axes', 'any axis')[count - 2]}"
            )
            said.append(f"the object looks alike when it is turned {about} (+-{worst:.0f} degrees)")
        if self.rival and self.rival[0] < 1 + CLEAR_MARGIN:
            said.append(
                f"a pose turned by {self.rival[1]:.0f} degrees explains the video nearly as well"
                f" (squared residual {self.rival[0]:.2f} times as large)"
            )
        return "; ".join(said)

    def deviations(self, part: slice, axes: np.ndarray | None = None) -> np.ndarray:
        """Standard deviations (3,) of a part of the unknowns, along the world's axes or others (3, 3)."""
        axes = np.eye(3) if axes is None else axes
        return np.sqrt(np.maximum(np.diag(axes @ self.covariance[part, part] @ axes.T), 0))

    def velocity(self) -> dict[str, Any]:
        """The initial motion, for velocity.json (`neuma_lib.coupling.initial_motion.InitialMotion.of`)."""
        motion = self.found.motion
        return {
            "v0": motion.velocity.tolist(),
            "angular_velocity": motion.spin.tolist(),
            "centre": motion.centre.tolist(),
            "units": {"v0": "m/s", "angular_velocity": "rad/s", "centre": "m"},
            "std": self.deviations(VELOCITY).tolist(),
            "camera_axes": self.axes.tolist(),
            "std_camera": self.deviations(VELOCITY, self.axes).tolist(),
            "angular_velocity_std": self.deviations(SPIN).tolist(),
            "angular_velocity_std_camera": self.deviations(SPIN, self.axes).tolist(),
        }

    def report(self) -> dict[str, Any]:
        """What is known, for people and later stages."""
        by_camera = {
            when: {
                name: {
                    "iou": float(found.iou[found.camera == k].mean()),
                    "least_iou": float(found.iou[found.camera == k].min()),
                    "centroid_px": float(found.off[found.camera == k].mean()),
                    "rms": float(np.sqrt(np.square(found.rms[found.camera == k]).mean())),
                }
                for k, name in enumerate(self.names)
            }
            for when, found in (("before", self.before), ("after", self.after))
        }
        offsets = np.zeros(len(self.names))
        offsets[1:] = np.sqrt(np.maximum(np.diag(self.covariance)[OFFSETS:], 0))
        return {
            "t0_s": self.start,
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
            "scale": self.scale,
            "pivot": self.pivot.tolist(),
            "centre": self.found.motion.centre.tolist(),
            "turn_deg": float(np.degrees(Rotation.from_matrix(self.rotation).magnitude())),
            "rotation_std_deg": np.degrees(self.deviations(TURN)).tolist(),
            "rotation_std_deg_principal": self.turn_deviations.tolist(),
            "centre_std": self.deviations(PLACE).tolist(),
            "covariance": self.covariance.tolist(),
            "enlargement": self.found.enlargement,
            "enlargement_std": float(np.sqrt(max(self.covariance[SIZE, SIZE], 0))),
            "offsets_s": dict(zip(self.names, self.found.offsets.tolist())),
            "offsets_std_s": dict(zip(self.names, offsets.tolist())),
            "gains": dict(zip(self.names, self.found.gains.tolist())),
            "spin_told": self.spin_told,
            "rival": {"cost": self.rival[0], "angle_deg": self.rival[1]} if self.rival else None,
            "ambiguous": self.ambiguous,
            "pictures": self.pictures[0],
            "side_px": self.pictures[1],
            **by_camera,
            "units": {"translation": "m", "centre": "m"},
        }

    def summary(self) -> str:
        """A line for people."""
        motion, worst = self.found.motion, self.turn_deviations[-1]
        other = f"next pose {self.rival[0]:.2f} times the squared residual" if self.rival else "no other pose"
        return (
            f"turned by {np.degrees(Rotation.from_matrix(self.rotation).magnitude()):.1f} +- {worst:.1f} degrees,"
            f" placed within {1000 * self.deviations(PLACE).max():.1f} mm; IoU {self.before.iou.mean():.3f} before,"
            f" {self.after.iou.mean():.3f} after; v0 ({', '.join(f'{x:+.3f}' for x in motion.velocity)}) +-"
            f" {self.deviations(VELOCITY).max():.3f} m/s, spin ({', '.join(f'{x:+.2f}' for x in motion.spin)}) +-"
            f" {self.deviations(SPIN).max():.2f} rad/s; {other}"
        )
