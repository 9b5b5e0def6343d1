"""Settings of experiments: learned laws, put to use elsewhere."""

from __future__ import annotations

from pydantic import Field, model_validator

from neuma_lib.config.base import Section, Vector


class BodyConfig(Section):
    """A body of an experiment."""

    scene: str = Field(description="scene whose material it has: the true law, or the one learned there")
    shape: str | None = Field(
        None,
        description="name of a shape, whose mesh is known to the truth and to the prediction; null: the scene's own "
        "object, reconstructed, and its estimated velocity",
    )
    size: float | None = Field(
        None, gt=0, description="longest side of the bounding box [m]; null: the shape's own"
    )
    height: float | None = Field(
        None, description="y of the bounding box's centre at the start [m]; null: the scene's"
    )
    center: tuple[float, float] | None = Field(
        None, description="x and z of the bounding box's centre [m]; null: the scene's"
    )
    velocity: Vector | None = Field(None, description="initial velocity [m/s]; null: the scene's")
    spin: Vector | None = Field(
        None, description="initial angular velocity about the centre of mass [rad/s]; null: the scene's"
    )

    @model_validator(mode="after")
    def _placed_only_with_a_shape(self) -> BodyConfig:
        placed = [
            key for key in ("size", "height", "center", "velocity", "spin") if getattr(self, key) is not None
        ]
        if self.shape is None and placed:
            raise ValueError(
                f"{', '.join(placed)}: a reconstructed object starts as in its scene; name a shape"
            )
        return self


class ExperimentConfig(Section):
    """Laws learned in scenes, put to use elsewhere: on another shape, together, or for longer."""

    title: str = Field(description="name in tables")
    bodies: tuple[BodyConfig, ...] = Field(min_length=1, description="what moves, on one grid")
    steps: int = Field(gt=0, description="simulated steps")
    dt: float | None = Field(
        None, gt=0, description="time step [s]; null: the smallest of the bodies' scenes"
    )
