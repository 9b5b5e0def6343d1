"""Settings of the simulator."""

import math
from typing import Any, Literal

from pydantic import Field, ValidationInfo, field_validator

from neuma_lib.config.base import Section, Vector

GRAVITY = 9.81  # gravity in the room of a capture [m/s^2]


WALLS = ("x_min", "x_max", "y_min", "y_max", "z_min", "z_max")
CONDITIONS = ("no_slip", "slip", "sticky")  # as of `neuma_lib.sim.model`, which settings do not import


class SimulationConfig(Section):
    """The material point method."""

    grid: int = Field(36, ge=8, description="grid cells along each side of the unit cube")
    gravity: Vector = Field((0.0, -9.8, 0.0), description="acceleration [m/s^2]")
    contact: Literal["particles", "nodes", "released"] = Field(
        "particles",
        description="contact of particles with the faces of the cube; wall nodes outside the cube, so that bodies rest "
        "near y = 0; or wall nodes inside, with clamped particles, as in the authors' released code. Scenes "
        "with colliders have contact of particles",
    )
    boundary: str | float | dict[str, str | float] = Field(
        "no_slip",
        description="condition of all walls, or of each wall (x_min, ...): no_slip, slip or sticky, or the Coulomb "
        "coefficient for contact of particles",
    )

    @field_validator("boundary", mode="before")  # pydantic would name every type of the union
    @classmethod
    def _conditions(cls, boundary: Any, info: ValidationInfo) -> Any:
        by_wall = boundary if isinstance(boundary, dict) else {WALLS[0]: boundary}
        of_particles = info.data.get("contact") == "particles"
        names = CONDITIONS[:-1] if of_particles else CONDITIONS
        known = f"{', '.join(names)}{' or a Coulomb coefficient of at least 0' * of_particles}"
        for wall, condition in by_wall.items():
            if wall not in WALLS:
                raise ValueError(f"no wall {wall!r}, expected {', '.join(WALLS)}")
            if isinstance(condition, int | float) and not isinstance(condition, bool):
                if not of_particles:
                    raise ValueError(f"a Coulomb coefficient needs contact of particles, expected {known}")
                if 0 <= condition < math.inf:
                    continue
            if condition not in names:
                raise ValueError(f"no condition {condition!r}, expected {known}")
        return boundary
