"""Settings of bodies at rest in photographs."""

from typing import Self

from pydantic import Field, model_validator

from neuma_lib.config.base import Section, Vector, internal
from neuma_lib.config.obstacles import RegionConfig
from neuma_lib.config.validation import hint
from neuma_lib.errors import InputError


class RestingBodyConfig(Section):
    """A clamped body that hangs at rest, in the frame of its mesh after scaling."""

    record: str = Field(description="name of the record in frames.json")
    mesh: str = Field(description="closed surface of blocks, relative to `stills.root`")
    unit: float = Field(1.0, gt=0, description="unit of length of the mesh [m]")
    rotation: Vector = Field(
        (0.0, 0.0, 0.0), description="rotation vector from the body's frame to the marker's [rad]"
    )
    placement: Vector = Field(
        description="origin of the body in the marker's frame, y up, before the fit [m]"
    )
    placement_std: float = Field(
        0.004, gt=0, description="standard deviation of the placement on each axis [m]"
    )
    clamps: dict[str, RegionConfig] = Field(
        min_length=1, description="regions that may be held, by name: alternatives, with a fit each"
    )
    hidden: RegionConfig = Field(description="region of the undeformed body that other objects hide or stain")
    nu: float = internal(0.49, "Poisson's ratio of the neo-Hookean solid", ge=0, lt=0.5)
    predicted_from: str | None = Field(
        None,
        description="body of the same material whose mu / rho predicts this one; null: mu / rho is fitted",
    )


class SwingConfig(Section):
    """Silhouettes of a body that is held, as a still shows, and then released."""

    body: str = Field(description="body of `stills.bodies` whose mu / rho predicts the motion")
    still: str = Field(description="name in frames.json of the record of the held body")
    silhouettes: str = Field(
        description="folder of the label maps, with times.json, relative to `stills.root`"
    )
    held: RegionConfig = Field(description="region of the undeformed body that a force against gravity holds")


class StillsConfig(Section):
    """Stiffness over density of bodies at rest under gravity, each in photographs with one marker."""

    root: str = Field("", description="folder of the records, with frames.json and calibration.json")
    sizes: tuple[float, float] = internal(
        (0.03, 0.015), "largest edge of an element in two meshes, from which results are extrapolated [m]"
    )
    photographs: bool = internal(
        True, "whether the figure has the photographs, whose licence may not allow to pass it on"
    )
    bodies: dict[str, RestingBodyConfig] = Field({}, description="bodies by name")
    swings: dict[str, SwingConfig] = Field({}, description="released bodies by name")
    cells: tuple[float, ...] = internal(
        (0.01, 0.0075), "edge of a cell of the simulation of swings [m], with a result for each", min_length=1
    )

    @model_validator(mode="after")
    def _agree(self) -> Self:
        if not self.sizes[0] > self.sizes[1] > 0:
            raise InputError("sizes", f"{list(self.sizes)} must be two positive sizes, the larger first")
        for name, body in self.bodies.items():
            source = body.predicted_from
            if source is not None and (source not in self.bodies or self.bodies[source].predicted_from):
                fitted = [key for key, other in self.bodies.items() if other.predicted_from is None]
                problem = f"{source!r} is no body whose mu / rho is fitted{hint(source, fitted)}"
                raise InputError(f"bodies.{name}.predicted_from", problem)
        for name, swing in self.swings.items():
            if swing.body not in self.bodies or self.bodies[swing.body].predicted_from:
                fitted = [key for key, other in self.bodies.items() if other.predicted_from is None]
                problem = f"{swing.body!r} is no body whose mu / rho is fitted{hint(swing.body, fitted)}"
                raise InputError(f"swings.{name}.body", problem)
        return self
