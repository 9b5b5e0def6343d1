"""Settings of a scene: a benchmark."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from neuma_lib.config.base import Section, Vector
from neuma_lib.config.blender import AppearanceConfig
from neuma_lib.config.dataset import TruthConfig
from neuma_lib.config.laws import LawConfig
from neuma_lib.config.splats import SplatConfig


class SplitDensityConfig(Section):
    """Two mass densities on either side of a plane."""

    axis: Literal["x", "y", "z"] = Field("x", description="axis that the plane is normal to")
    at: float = Field(0.5, description="where the plane cuts the axis [m]")
    below: float = Field(gt=0, description="density on the side of smaller coordinates [kg/m^3]")
    above: float = Field(gt=0, description="density on the other side [kg/m^3]")


class SuppliedConfig(Section):
    """Image sets that were made elsewhere.

    A transforms.json, a list in the layout of the authors' release, or a folder or list in PAC-NeRF's layout
    (all_data.json) or that of Spring-Gaus' synthetic scenes (camera.json), whose first frames are the views at t = 0.
    """

    static: str | None = Field(None, description="views at t = 0; null: rendered by Blender")
    dynamic: str | None = Field(
        None, description="videos with the frames that the scene's settings name; null: rendered by Blender"
    )
    stride: int | None = Field(
        None,
        ge=1,
        description="simulated steps from frame to frame of a folder that counts its frames, as PAC-NeRF's and "
        "Spring-Gaus' do; then the scene's frames are all of these up to its steps, unless it lists some of them",
    )
    scale: float = Field(
        1.0,
        gt=0,
        description="metres of the simulator to a metre of the images' world; all lengths are scaled",
    )
    offset: Vector | None = Field(
        None,
        description="where the scaled origin of the images' world is in the simulator's box [m]; null: as the layout "
        "has it, (0.5, 0, 0.5) for PAC-NeRF, (0, -0.3, 0) for Spring-Gaus, else (0, 0, 0)",
    )


class CapturedConfig(Section):
    """What a scene shows of a capture; the workflow writes it for each folder of captures.root."""

    capture: str = Field(description="name of the capture")
    throw: str | None = Field(None, description="its throw; null: the object as photographed")
    cameras: tuple[str, ...] = Field((), description="cameras that filmed the throw, by name")
    scale: float = Field(1.0, gt=0, description="metres of the simulator to a metre of the room")
    grid: int | None = Field(
        None, ge=8, description="grid cells along each side of the box; null: captures.grid"
    )


OF_THE_TRUTH = ("shape", "height", "velocity", "law", "appearance")
"""Keys of what is simulated and rendered: nobody knows them of a captured object."""
OF_A_VIDEO = ("steps",)
"""Keys that the files of a captured video tell."""
OF_A_SPLAT = {
    "size": 0.4, "height": 0.5, "velocity": (0.0, 0.0, 0.0), "dt": 5e-4, "steps": 1000, "prior": "jelly",
    **dict.fromkeys(("shape", "law", "appearance")),
}  # fmt: skip
"""What the keys of a scene with a splat are where they are not given: half a second's fall from half a metre."""


class SceneConfig(Section):
    """A benchmark: what is thrown, of what, how, and what is believed about it.

    Or a capture: what was filmed. Or a splat: what learned laws move.
    """

    like: str | None = Field(
        None, description="scene whose settings stand wherever this one has none of its own; null: none"
    )
    shape: str | None = Field(
        description="name of the shape: ball, duck, pawn, cat, bottle, fish or letter_X"
    )
    size: float | None = Field(
        None, gt=0, description="longest side of the bounding box [m]; null: the shape's own"
    )
    height: float | None = Field(description="y of the bounding box's centre at the start [m]")
    center: tuple[float, float] = Field((0.5, 0.5), description="x and z of the bounding box's centre [m]")
    velocity: Vector | None = Field(description="initial velocity [m/s]")
    spin: Vector = Field(
        (0.0, 0.0, 0.0), description="initial angular velocity about the centre of mass, world axes [rad/s]"
    )
    density: Annotated[float, Field(gt=0)] | SplitDensityConfig = Field(
        1000.0,
        description="mass density rho [kg/m^3], or two of them at t = 0: {axis: x, at: 0.5, below: 800, above: 1200}",
    )
    law: LawConfig | None = Field(description="the true material, known to the ground truth only")
    truth: TruthConfig = Field(
        TruthConfig(),
        description="how finely its ground truth is simulated, where it has settings of its own",
    )
    dt: float = Field(gt=0, description="time step of the reconstruction, which frames are counted in [s]")
    steps: int | None = Field(gt=0, description="simulated steps of the video")
    frames: tuple[int, ...] | None = Field(
        None,
        description="steps of the video's frames, ascending from 0; null: as images.stride, dataset.frames or "
        "dataset.stride say",
    )
    prior: str = Field(description="name in priors.laws, or path of a .safetensors or a released .pt file")
    appearance: AppearanceConfig | None = Field(description="how Blender shows it")
    images: SuppliedConfig = Field(
        SuppliedConfig(), description="files of its images, where Blender makes none"
    )
    captured: CapturedConfig | None = Field(
        None,
        description="which capture this is, whose scenes have no truth; written by the workflow, not by hand",
    )
    splat: SplatConfig | None = Field(
        None,
        description="Gaussians of an object made elsewhere, or their file alone. The scene has no truth then, "
        "and size 0.4, height 0.5, velocity 0, dt 5e-4, steps 1000 and the prior jelly where it says nothing else",
    )
    videos: tuple[str, ...] = Field(
        (),
        description="further scenes of the same material: one law is trained with all these videos, which count alike, "
        "however long. In place of a name, settings that differ from this scene's make another throw of its object, "
        "the scene `<name>_throw2`, or 3, ... by its place in the list. Not handed on by `like`",
    )
    story: str = Field("", description="in which way the prior is wrong, in words")
    training: dict[str, Any] = Field(
        {}, description="settings of the section training that this scene overrides"
    )

    @property
    def has_truth(self) -> bool:
        """Whether the material and the throw are known: not of captured objects, nor of splats."""
        return self.captured is None and self.splat is None

    @model_validator(mode="before")
    @classmethod
    def _without_truth(cls, raw: Any) -> Any:
        """A scene of a capture or a splat need not say that it has no truth."""
        if not isinstance(raw, Mapping):
            return raw
        if isinstance(raw.get("splat"), str):
            raw = {**raw, "splat": {"file": raw["splat"]}}
        if raw.get("splat"):
            return {**OF_A_SPLAT, **raw}
        return {**dict.fromkeys((*OF_THE_TRUTH, *OF_A_VIDEO)), **raw} if raw.get("captured") else raw

    @model_validator(mode="after")
    def _truth_is_whole(self) -> SceneConfig:
        unknown = OF_A_SPLAT if self.splat else {}
        for key in (*OF_THE_TRUTH, *OF_A_VIDEO):
            if self.captured is None and getattr(self, key) is None and unknown.get(key, ...) is not None:
                raise ValueError(f"{key}: null stands in scenes of captures only, give it a value")
        if self.splat and self.captured:
            raise ValueError("splat: this scene is one of a capture; name the scene of the splat otherwise")
        return self

    @model_validator(mode="after")
    def _frames_ascend(self) -> SceneConfig:
        frames = self.frames
        if frames is not None and (
            list(frames) != sorted(set(frames))
            or not frames
            or frames[0] != 0
            or frames[-1] > (self.steps or 0)
        ):
            raise ValueError("frames must ascend from 0 to at most 'steps' without repeats")
        stride = self.images.stride
        for step in frames or () if stride else ():
            if step % stride:
                raise ValueError(
                    f"frames: step {step} is none of the supplied frames, images.stride: {stride}"
                )
        return self
