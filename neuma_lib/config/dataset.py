"""Settings of ground truths and their images."""

from __future__ import annotations

from pydantic import Field, model_validator

from neuma_lib.config.base import Section
from neuma_lib.config.blender import BlenderConfig, ImagesConfig


class TruthConfig(Section):
    """How finely the ground truth of one scene is simulated."""

    grid: int | None = Field(None, ge=8, description="its grid; null: dataset.grid")
    dt: float | None = Field(None, gt=0, description="its time step [s]; null: dataset.dt")
    particles: int | None = Field(None, gt=0, description="its particles; null: dataset.particles")


class DatasetConfig(Section):
    """Ground truth and its images."""

    particles: int = Field(
        8000, gt=0, description="ground-truth particles, at least four times the reconstruction's"
    )
    grid: int | None = Field(
        None, ge=8, description="grid nodes of the ground truth along each side; null: simulation.grid"
    )
    dt: float | None = Field(
        None,
        gt=0,
        description="time step of the ground truth [s], which goes evenly into the scene's; null: the scene's",
    )
    seed: int = Field(
        1000,
        description="seed of the ground truth's particles; the next two draw its tracers. Apart from those of the "
        "reconstruction: seed, and the chains after it",
    )
    steps: int | None = Field(None, gt=0, description="steps of every video; null: those of its scene")
    frames: int | None = Field(
        25, ge=2, description="frames of a video, evenly from step 0 to the last, for scenes that list none"
    )
    stride: int | None = Field(
        None, ge=1, description="steps between two frames; in place of frames, which is null then"
    )
    exposure_samples: int = Field(
        5,
        ge=1,
        description="most renders that are averaged to one frame where transforms.json states its exposure; they are "
        "at least a step apart. 1: motion blur is ignored",
    )
    tracers: int = Field(100_000, gt=0, description="passive tracers that measure the motion of the truth")
    static: ImagesConfig = Field(ImagesConfig(views=50), description="views on a sphere at t = 0")
    dynamic: ImagesConfig = Field(
        ImagesConfig(views=3, width=96, height=96), description="videos, view 0 frontal"
    )
    blender: BlenderConfig = Field(BlenderConfig(), description="how both sets of images are rendered")

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
