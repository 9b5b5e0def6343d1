"""Settings of the ground truth and its images."""

from __future__ import annotations

from pydantic import Field, model_validator

from neuma_lib.config.base import Section, Seed
from neuma_lib.config.blender import BlenderConfig, ImagesConfig


class TruthConfig(Section):
    """Resolution of the ground truth of one scene."""

    grid: int | None = Field(None, ge=8, description="grid cells along each side; null: dataset.grid")
    dt: float | None = Field(None, gt=0, description="time step [s]; null: dataset.dt")
    particles: int | None = Field(None, gt=0, description="number of particles; null: dataset.particles")


class DatasetConfig(Section):
    """Ground truth and its images."""

    particles: int = Field(
        8000, gt=0, description="particles of the ground truth, at least four times geometry.particles"
    )
    grid: int | None = Field(
        None, ge=8, description="grid cells of the ground truth along each side; null: simulation.grid"
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
    def _one_rule_for_frames(self) -> DatasetConfig:
        if (self.frames is None) == (self.stride is None):
            raise ValueError("give either frames or stride, and null for the other")
        return self

    def frame_steps(self, steps: int) -> tuple[int, ...]:
        """Steps of the frames of a video of ``steps`` steps."""
        if self.stride is not None:
            return tuple(range(0, steps + 1, self.stride))
        count = min(self.frames, steps + 1)
        return tuple(round(i * steps / max(count - 1, 1)) for i in range(count))
