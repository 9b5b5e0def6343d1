"""Settings of the simulator."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from neuma_lib.config.base import Section, Vector

GRAVITY = 9.81
"""Gravity in the room of a capture [m/s^2]."""


WALLS = ("x_min", "x_max", "y_min", "y_max", "z_min", "z_max")
CONDITIONS = ("no_slip", "slip", "sticky")
"""As of `neuma_lib.sim.model`, which settings do not import."""


def _conditions(boundary: str | dict[str, str]) -> str | dict[str, str]:
    named = boundary if isinstance(boundary, dict) else {WALLS[0]: boundary}
    for wall, condition in named.items():
        if wall not in WALLS:
            raise ValueError(f"no wall {wall!r}, expected {', '.join(WALLS)}")
        if condition not in CONDITIONS:
            raise ValueError(f"no condition {condition!r}, expected {', '.join(CONDITIONS)}")
    return boundary


class SimulationConfig(Section):
    """The material point method."""

    grid: int = Field(24, ge=8, description="grid cells along each side of the unit cube")
    gravity: Vector = Field((0.0, -9.8, 0.0), description="acceleration [m/s^2]")
    boundary: Annotated[str | dict[str, str], AfterValidator(_conditions)] = Field(
        "no_slip", description="condition of all walls, no_slip, slip or sticky, or of each wall (x_min, ...)"
    )
    contact: Literal["particles", "nodes", "released"] = Field(
        "nodes",
        description="contact of particles with the faces of the cube; wall nodes outside the cube, so that bodies rest "
        "near y = 0; or wall nodes inside, with clamped particles, as in the authors' released code. Scenes with "
        "colliders have contact of particles",
    )
