"""Settings of experiments: learned laws on other bodies, several bodies, or longer motions."""

from typing import Self

from pydantic import Field, model_validator

from neuma_lib.config.base import Section, Vector
from neuma_lib.config.obstacles import ClampConfig, ColliderConfig


class BodyConfig(Section):
    """A body of an experiment."""

    scene: str = Field(description="scene of its material: the true law, or the law learned there")
    shape: str | None = Field(
        None,
        description="name of a shape, or the path of a mesh; null: the reconstructed object of the scene, with its "
        "estimated initial motion",
    )
    size: float | None = Field(
        None, gt=0, description="longest side of the bounding box [m]; null: the shape's own"
    )
    height: float | None = Field(
        None, description="initial y of the centre of the bounding box [m]; null: the scene's"
    )
    center: tuple[float, float] | None = Field(
        None, description="initial x and z of the centre of the bounding box [m]; null: the scene's"
    )
    velocity: Vector | None = Field(None, description="initial velocity [m/s]; null: the scene's")
    spin: Vector | None = Field(None, description="initial angular velocity [rad/s]; null: the scene's")

    @model_validator(mode="after")
    def _placed_only_with_a_shape(self) -> Self:
        placed = [
            key for key in ("size", "height", "center", "velocity", "spin") if getattr(self, key) is not None
        ]
        if self.shape is None and placed:
            problem = f"{', '.join(placed)}: a reconstructed object starts as in its scene; give a shape"
            raise ValueError(problem)
        return self


class ExperimentConfig(Section):
    """Use of laws outside the scene in which they were learned."""

    title: str = Field(description="name in tables")
    bodies: tuple[BodyConfig, ...] = Field(min_length=1, description="bodies on one grid")
    steps: int = Field(gt=0, description="simulated steps")
    dt: float | None = Field(None, gt=0, description="time step [s]; null: the smallest of the scenes")
    colliders: tuple[ColliderConfig, ...] | None = Field(
        None, description="obstacles, as of a scene; null: those of the scene of the first body"
    )
    clamps: tuple[ClampConfig, ...] = Field((), description="regions of the bodies that are held or moved")
