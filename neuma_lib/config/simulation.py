"""Settings of the simulator."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from neuma_lib.config.base import Section, Vector

GRAVITY = 9.81
"""Gravity in the room of a capture [m/s^2]."""


class SimulationConfig(Section):
    """The material point method."""

    grid: int = Field(24, ge=8, description="grid cells along each side of the unit cube")
    gravity: Vector = Field((0.0, -9.8, 0.0), description="acceleration [m/s^2]")
    boundary: str | dict[str, str] = Field(
        "no_slip", description="condition of all walls, no_slip, slip or sticky, or of each wall (x_min, ...)"
    )
    contact: Literal["particles", "nodes", "released"] = Field(
        "nodes",
        description="contact of particles with the faces of the cube; wall nodes outside the cube, so that bodies rest "
        "near y = 0; or wall nodes inside, with clamped particles, as in the authors' released code",
    )
