"""Initial motion of a body with its uncertainty, which can be corrected once the material is known."""

from __future__ import annotations

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
            What is 0 is known.
    """

    velocity: np.ndarray
    spin: np.ndarray
    centre: np.ndarray
    axes: np.ndarray
    std: np.ndarray

    @classmethod
    def of(cls, found: Mapping[str, Any]) -> InitialMotion:
        """From the content of velocity.json; known exactly where that gives no standard deviations."""
        std = [found.get(key, (0, 0, 0)) for key in ("std_camera", "angular_velocity_std_camera")]
        motion = (np.asarray(found[key], dtype=float) for key in ("v0", "angular_velocity", "centre"))
        axes = np.asarray(found.get("camera_axes", np.eye(3)), dtype=float)
        return cls(*motion, axes, np.concatenate(std).astype(float))

    def moved(self, deviations: np.ndarray) -> InitialMotion:
        """With a deviation (6,) in standard deviations added."""
        velocity, spin = (self.std * deviations).reshape(2, 3) @ self.axes
        return replace(self, velocity=self.velocity + velocity, spin=self.spin + spin)

    def of_body(self, body: Reconstruction) -> State:
        """The particles in this motion."""
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
