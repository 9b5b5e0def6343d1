"""Initial motion of a body with its uncertainty, which can be corrected once the material is known."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.sim.state import State


@dataclass(frozen=True)
class InitialMotion:
    """Initial motion of a body with its uncertainty.

    Attributes:
        velocity: of the centre [m/s], shape (3,).
        spin: angular velocity about the centre [rad/s], shape (3,).
        centre: point that moves with `velocity` [m], shape (3,).
        axes: rows are the directions in which errors are independent, shape (3, 3): the camera's right, down and depth.
        std: standard deviations of the velocity along these axes [m/s] and of the spin about them [rad/s], shape (6,).
            0 where the value is exact.
    """

    velocity: np.ndarray
    spin: np.ndarray
    centre: np.ndarray
    axes: np.ndarray
    std: np.ndarray

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> "InitialMotion":
        """From the content of velocity.json. Without standard deviations the motion is exact."""
        std = [content.get(key, (0, 0, 0)) for key in ("std_camera", "angular_velocity_std_camera")]
        v0, spin, centre = (np.asarray(content[key], float) for key in ("v0", "angular_velocity", "centre"))
        axes = np.asarray(content.get("camera_axes", np.eye(3)), dtype=float)
        return cls(v0, spin, centre, axes, np.concatenate(std).astype(float))

    def moved(self, deviations: np.ndarray) -> "InitialMotion":
        """Add a deviation (6,), in units of the standard deviations."""
        velocity, spin = (self.std * deviations).reshape(2, 3) @ self.axes
        return replace(self, velocity=self.velocity + velocity, spin=self.spin + spin)

    def of_body(self, body: Reconstruction) -> State:
        """State of the particles of a body in this motion."""
        return body.state(self.velocity, self.spin, self.centre)

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, for JSON, with the keys of velocity.json."""
        return {
            "v0": self.velocity.tolist(),
            "angular_velocity": self.spin.tolist(),
            "centre": self.centre.tolist(),
            "camera_axes": self.axes.tolist(),
            "std_camera": self.std[:3].tolist(),
            "angular_velocity_std_camera": self.std[3:].tolist(),
        }
