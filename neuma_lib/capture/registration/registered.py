"""Result of the registration of a photographed object to its video: pose, motion, uncertainty and ambiguity."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from neuma_lib.capture.registration.problem import OFFSETS, PLACE, SIZE, SPIN, TURN, VELOCITY, FittedPose
from neuma_lib.capture.registration.rigid_views import Agreement, Comparison

CLEAR_MARGIN = 0.25
"""Relative increase of the cost of the next distinct pose below which a pose is ambiguous: two standard deviations if
the residuals of a block count as one (`Linearisation.block_cost`)."""
_CLEAR_ANGLE = 10.0  # standard deviation of the rotation above which it is ambiguous [degrees]


@dataclass(frozen=True, eq=False)
class Registration:
    """A photographed object placed into its video, x_video = s R x_photo + t at the time `start`."""

    names: tuple[str, ...]  # of the cameras
    start: float  # time of the first frame of the flight in all cameras, by the clock of the first one [s]
    pivot: np.ndarray  # centre of mass as photographed [m], (3,)
    scale_known: bool  # whether photographs and video have the same scale, s = 1
    pose: FittedPose  # pose and motion
    # (15 + cameras,) squared, of rotation about the world axes [rad], centre [m], velocity [m/s], spin
    # [rad/s], enlargement, gravity [m/s^2] and offsets of all cameras but the first [s]; 0 for fixed values
    # such as gravity
    covariance: np.ndarray
    # gravity, gravity_covariance: fitted gravity [m/s^2], (3,) and (3, 3)
    gravity: np.ndarray
    gravity_covariance: np.ndarray
    # before, after: agreement of the object in the orientation of the photographs, and as registered
    before: Agreement
    after: Agreement
    # cost of the next distinct pose relative to that of the best one, and the angle between them [degrees],
    # or None if no other pose is left
    rival: tuple[float, float] | None
    spin_significant: bool  # whether the spin differs significantly from 0; it is 0 otherwise
    pictures: tuple[int, int]  # number of pictures in the last stage, and their side [px]
    axes: np.ndarray  # rows are the first camera's right, down and viewing direction, (3, 3)
    comparisons: list[Comparison]  # pictures of each camera with their renders

    @property
    def rotation(self) -> np.ndarray:
        return self.pose.motion.rotation

    @property
    def scale(self) -> float:
        return 1.0 if self.scale_known else 1.0 + self.pose.enlargement

    @property
    def translation(self) -> np.ndarray:
        return self.pose.motion.centre - self.scale * self.rotation @ self.pivot

    def place(self, x: np.ndarray) -> np.ndarray:
        """Transform points (N, 3) [m] of the photographed object to the video at the time `start`."""
        return self.scale * x @ self.rotation.T + self.translation

    @property
    def turn_deviations(self) -> np.ndarray:
        """Standard deviations of the rotation about its principal axes [degrees], ascending, (3,)."""
        return np.degrees(np.sqrt(np.maximum(np.linalg.eigvalsh(self.covariance[TURN, TURN]), 0)))

    @property
    def ambiguous(self) -> str:
        """Description of the ambiguity of the pose, empty if there is none."""
        texts = []
        worst = self.turn_deviations[-1]
        if worst > _CLEAR_ANGLE:
            _, vectors = np.linalg.eigh(self.covariance[TURN, TURN])
            count = int((self.turn_deviations > _CLEAR_ANGLE).sum())
            axis = ", ".join(f"{x:.2f}" for x in vectors[:, -1])
            axes = (f"the axis ({axis})", "two axes", "any axis")[count - 1]
            texts.append(f"the object looks alike when it is turned about {axes} (+-{worst:.0f} degrees)")
        if self.rival and self.rival[0] < 1 + CLEAR_MARGIN:
            texts.append(
                f"a pose turned by {self.rival[1]:.0f} degrees explains the video nearly as well"
                f" (squared residual {self.rival[0]:.2f} times as large)"
            )
        return "; ".join(texts)

    def deviations(self, part: slice, axes: np.ndarray | None = None) -> np.ndarray:
        """Standard deviations (3,) of some unknowns along the world axes or other axes (3, 3)."""
        axes = np.eye(3) if axes is None else axes
        return np.sqrt(np.maximum(np.diag(axes @ self.covariance[part, part] @ axes.T), 0))

    def velocity(self) -> dict[str, Any]:
        """The initial motion, for velocity.json (`neuma_lib.coupling.initial_motion.InitialMotion.of`)."""
        motion = self.pose.motion
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
        """JSON values for the report and later stages."""
        offsets = np.zeros(len(self.names))
        offsets[1:] = np.sqrt(np.maximum(np.diag(self.covariance)[OFFSETS:], 0))
        return {
            "t0_s": self.start,
            "rotation": self.rotation.tolist(),
            "translation": self.translation.tolist(),
            "scale": self.scale,
            "pivot": self.pivot.tolist(),
            "centre": self.pose.motion.centre.tolist(),
            "turn_deg": float(np.degrees(Rotation.from_matrix(self.rotation).magnitude())),
            "rotation_std_deg": np.degrees(self.deviations(TURN)).tolist(),
            "rotation_std_deg_principal": self.turn_deviations.tolist(),
            "centre_std": self.deviations(PLACE).tolist(),
            "covariance": self.covariance.tolist(),
            "enlargement": self.pose.enlargement,
            "enlargement_std": float(np.sqrt(max(self.covariance[SIZE, SIZE], 0))),
            "offsets_s": dict(zip(self.names, self.pose.offsets.tolist())),
            "offsets_std_s": dict(zip(self.names, offsets.tolist())),
            "gains": dict(zip(self.names, self.pose.gains.tolist())),
            "spin_told": self.spin_significant,
            "rival": {"cost": self.rival[0], "angle_deg": self.rival[1]} if self.rival else None,
            "ambiguous": self.ambiguous,
            "pictures": self.pictures[0],
            "side_px": self.pictures[1],
            "before": self.before.by_camera(self.names),
            "after": self.after.by_camera(self.names),
            "units": {"translation": "m", "centre": "m"},
        }

    def summary(self) -> str:
        """Summary line."""
        motion, worst = self.pose.motion, self.turn_deviations[-1]
        other = f"next pose {self.rival[0]:.2f} times the squared residual" if self.rival else "no other pose"
        return (
            f"turned by {np.degrees(Rotation.from_matrix(self.rotation).magnitude()):.1f} +- {worst:.1f} degrees,"
            f" placed within {1000 * self.deviations(PLACE).max():.1f} mm; IoU {self.before.iou.mean():.3f} before,"
            f" {self.after.iou.mean():.3f} after; v0 ({', '.join(f'{x:+.3f}' for x in motion.velocity)}) +-"
            f" {self.deviations(VELOCITY).max():.3f} m/s, spin ({', '.join(f'{x:+.2f}' for x in motion.spin)}) +-"
            f" {self.deviations(SPIN).max():.2f} rad/s; {other}"
        )
