"""Settings of the ground truth and its images."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from neuma_lib.config.base import Section, Seed, internal
from neuma_lib.config.blender import BlenderConfig, ImagesConfig

CONVERGED = "converged"

Cells = Annotated[int, Field(ge=8)]


class TruthConfig(Section):
    """Resolution of the ground truth of one scene. `truth: converged` is short for `truth: {grid: converged}`."""

    grid: Cells | Literal["converged"] | None = Field(
        None, description="grid cells along each side, as dataset.grid; null: dataset.grid"
    )
    dt: float | None = Field(None, gt=0, description="time step [s]; null: dataset.dt")
    particles: int | None = Field(
        None,
        gt=0,
        description="number of particles; null: dataset.particles, or 8 in a cell of a converged truth",
    )


class DatasetConfig(Section):
    """Ground truth and its images."""

    particles: int = Field(
        8000,
        gt=0,
        description="particles of the ground truth, at least four times geometry.particles. Its file has at most as "
        "many, drawn from those of a converged truth",
    )
    grid: Cells | Literal["converged"] | None = Field(
        None,
        description="grid cells of the ground truth along each side; null: simulation.grid; converged: 96 cells, or "
        "twice simulation.grid if that is more, with a time step refined by at least the same factor, 8 particles in a "
        "cell, and, unless truth.particles is given, an estimate of the change that a doubled grid would make",
    )
    converged_grid: int = internal(
        96, "grid cells of a converged ground truth along each side, an even number", ge=8, multiple_of=2
    )
    dt: float | None = Field(
        None,
        gt=0,
        description="time step of the ground truth [s], an integer fraction of the scene's; null: equal",
    )
    seed: Seed = Field(
        1000,
        description="seed of the particles of the ground truth; the next two sample its tracers. It must differ from "
        "the seeds of the reconstruction",
    )
    steps: int | None = Field(None, gt=0, description="steps of every video; null: those of its scene")
    frames: int | None = Field(
        25,
        ge=2,
        description="frames of a video, evenly spaced from step 0 to the last, if the scene lists none",
    )
    stride: int | None = Field(
        None, ge=1, description="steps between frames; an alternative to frames, which is null then"
    )
    exposure_samples: int = Field(
        5,
        ge=1,
        description="maximum number of renders averaged to a frame if transforms.json states its exposure, at least a "
        "step apart; 1: no motion blur",
    )
    tracers: int = Field(100_000, gt=0, description="passive tracers that measure the motion")
    static: ImagesConfig = Field(ImagesConfig(views=50), description="views on a sphere at t = 0")
    dynamic: ImagesConfig = Field(
        ImagesConfig(views=3, width=96, height=96), description="videos; view 0 is frontal"
    )
    blender: BlenderConfig = Field(BlenderConfig(), description="rendering of both image sets")

    @model_validator(mode="after")
    def _one_rule_for_frames(self) -> Self:
        if (self.frames is None) == (self.stride is None):
            raise ValueError("give either frames or stride, and null for the other")
        return self

    def frame_steps(self, steps: int) -> tuple[int, ...]:
        """Steps of the frames of a video of ``steps`` steps."""
        if self.stride is not None:
            return tuple(range(0, steps + 1, self.stride))
        count = min(self.frames, steps + 1)
        return tuple(round(i * steps / max(count - 1, 1)) for i in range(count))
