"""Settings of scenes."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from neuma_lib.config.base import Section, Vector, internal
from neuma_lib.config.blender import AppearanceConfig
from neuma_lib.config.dataset import CONVERGED, TruthConfig
from neuma_lib.config.laws import LawConfig
from neuma_lib.config.obstacles import ClampConfig, ColliderConfig
from neuma_lib.config.splats import SplatConfig


class SplitDensityConfig(Section):
    """Two mass densities on either side of a plane."""

    axis: Literal["x", "y", "z"] = Field("x", description="normal of the plane")
    at: float = Field(0.5, description="position of the plane on the axis [m]")
    below: float = Field(gt=0, description="density at smaller coordinates [kg/m^3]")
    above: float = Field(gt=0, description="density at larger coordinates [kg/m^3]")


class SuppliedConfig(Section):
    """Supplied image sets.

    A transforms.json, a list in the layout of the authors' release, or a folder or list in PAC-NeRF's layout
    (all_data.json) or that of Spring-Gaus' synthetic scenes (camera.json), whose first frames are the views at t = 0.
    """

    static: str | None = Field(None, description="views at t = 0; null: rendered by Blender")
    dynamic: str | None = Field(
        None, description="videos with the frames of the scene; null: rendered by Blender"
    )
    stride: int | None = Field(
        None,
        ge=1,
        description="simulated steps between frames, in layouts that number frames (PAC-NeRF, Spring-Gaus); the scene "
        "uses all of them, unless it lists frames",
    )
    scale: float = Field(1.0, gt=0, description="metres of the simulator per metre of the images' world")
    offset: Vector | None = Field(
        None,
        description="position of the scaled origin of the images' world [m]; null: (0.5, 0, 0.5) for PAC-NeRF, (0, "
        "-0.3, 0) for Spring-Gaus, else (0, 0, 0)",
    )


class CapturedConfig(Section):
    """The capture of a scene. The workflow sets it for each folder of captures.root."""

    capture: str = internal(..., "name of the capture")
    throw: str | None = internal(None, "its take; null: the object as photographed")
    cameras: tuple[str, ...] = internal((), "cameras of the take, by name")
    scale: float = internal(1.0, "metres of the simulator per metre of the room", gt=0)
    grid: int | None = internal(None, "grid cells along each side of the box; null: captures.grid", ge=8)


MAX_BODIES = 5  # bodies of a scene, as of `neuma_lib.sim.bodies`, which settings do not import
OF_THE_TRUTH = ("shape", "height", "velocity", "law", "appearance")
"""Keys of the simulation and the renders of the truth, unknown for a captured object."""
OF_A_VIDEO = ("steps",)  # keys that follow from the files of a captured video
OF_A_SPLAT = {
    "size": 0.4, "height": 0.5, "velocity": (0.0, 0.0, 0.0), "dt": 5e-4, "steps": 1000, "prior": "jelly",
    **dict.fromkeys(("shape", "law", "appearance")),
}  # fmt: skip
"""Defaults of a scene with a splat: half a second of fall from half a metre."""


class SceneBodyConfig(Section):
    """One of several bodies of a scene, which touch each other. Those of a capture have no truth."""

    shape: str | None = Field(description="name of a shape, or the path of a mesh, as of a scene")
    size: float | None = Field(
        None, gt=0, description="longest side of the bounding box [m]; null: the shape's own"
    )
    height: float | None = Field(description="initial y of the centre of the bounding box [m]")
    center: tuple[float, float] = Field(
        (0.5, 0.5), description="initial x and z of the centre of the bounding box [m]"
    )
    rotation: Vector = Field(
        (0.0, 0.0, 0.0), description="rotation vector of the shape, before it is placed [rad]"
    )
    velocity: Vector | None = Field((0.0, 0.0, 0.0), description="initial velocity [m/s]")
    spin: Vector = Field(
        (0.0, 0.0, 0.0), description="initial angular velocity about the centre of mass, world axes [rad/s]"
    )
    density: Annotated[float, Field(gt=0)] | SplitDensityConfig = Field(
        1000.0, description="mass density, as of a scene [kg/m^3]"
    )
    law: LawConfig | None = Field(description="the true material")
    family: str | None = internal(None, "a name in identify.families if it is known; null: it is selected")
    appearance: AppearanceConfig | None = Field(description="appearance in Blender")


class PairConfig(Section):
    """Contact of two bodies of a scene."""

    bodies: tuple[str, str] = Field(description="names of the two bodies")
    friction: float | None = Field(
        None, ge=0, description="Coulomb coefficient; null: they stick while they press on each other"
    )


class SceneConfig(Section):
    """A simulated object with its true law and the prior of its reconstruction, a captured object, or a splat.

    Or several bodies, each with its own shape, start and law, in place of these keys of the scene.
    """

    like: str | None = Field(None, description="scene with the settings that this one does not set")
    shape: str | None = Field(
        description="ball, duck, pawn, cat, bottle, fish, letter_X, or the path of a mesh (.obj, .ply, .stl, .glb) "
        "with y up"
    )
    size: float | None = Field(
        None, gt=0, description="longest side of the bounding box [m]; null: the shape's own"
    )
    height: float | None = Field(description="initial y of the centre of the bounding box [m]")
    center: tuple[float, float] = Field(
        (0.5, 0.5), description="initial x and z of the centre of the bounding box [m]"
    )
    rotation: Vector = Field(
        (0.0, 0.0, 0.0),
        description="rotation vector of the shape, before it is placed at height and center [rad]",
    )
    velocity: Vector | None = Field(description="initial velocity [m/s]")
    spin: Vector = Field(
        (0.0, 0.0, 0.0), description="initial angular velocity about the centre of mass, world axes [rad/s]"
    )
    density: Annotated[float, Field(gt=0)] | SplitDensityConfig = Field(
        1000.0,
        description="mass density [kg/m^3], or two at t = 0: {axis: x, at: 0.5, below: 800, above: 1200}",
    )
    colliders: tuple[ColliderConfig, ...] = Field(
        (), description="obstacles, in addition to the faces of the cube"
    )
    clamps: tuple[ClampConfig, ...] = Field((), description="regions of the body that are held or moved")
    # Random scenes draw it. They have contact of particles then.
    friction: float | None = internal(
        None, "Coulomb coefficient of the faces of the cube; null: simulation.boundary", ge=0
    )
    bodies: dict[str, SceneBodyConfig] = Field(
        {}, description="two to five bodies by name, in place of shape, height, velocity, law and appearance"
    )
    pairs: tuple[PairConfig, ...] = Field((), description="friction between bodies. Other pairs stick")
    law: LawConfig | None = Field(description="the true material, used by the ground truth only")
    truth: TruthConfig = Field(TruthConfig(), description="resolution of the ground truth")
    dt: float = Field(gt=0, description="time step of the reconstruction, the unit of frames and steps [s]")
    steps: int | None = Field(gt=0, description="simulated steps of the video")
    frames: tuple[int, ...] | None = Field(
        None,
        description="steps of the frames of the video, ascending from 0; null: from images.stride, dataset.frames or "
        "dataset.stride",
    )
    prior: str = Field(
        description="a name in priors.laws, or the path of a .safetensors or a released .pt file"
    )
    appearance: AppearanceConfig | None = Field(description="appearance in Blender")
    images: SuppliedConfig = Field(SuppliedConfig(), description="supplied image sets")
    captured: CapturedConfig | None = internal(
        None, "the capture of a scene without truth; the workflow sets it"
    )
    part_of: tuple[str, str] | None = internal(
        None, "scene of several bodies and name of the one that this scene shows; `project.loading` sets it"
    )
    splat: SplatConfig | None = Field(
        None,
        description="Gaussians of an object, or their file alone. Such a scene has no truth. Its defaults are size "
        "0.4, height 0.5, velocity 0, dt 5e-4, steps 1000, prior jelly",
    )
    videos: tuple[str, ...] = Field(
        (),
        description="other scenes of the same material, whose videos train the same law with equal weights. Settings "
        "that differ from this scene, in place of a name, define a take `<name>_throw2` of its object. "
        "`like` does not inherit it",
    )
    story: str = Field("", description="how the prior is wrong, in words")
    training: dict[str, Any] = Field(
        {}, description="settings of the section training that this scene overrides"
    )

    @property
    def has_truth(self) -> bool:
        """Whether the true law and motion of one body are known. They are not for captured objects and splats."""
        return self.captured is None and self.splat is None and not self.bodies

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, raw: Any) -> Any:
        """Write short forms in full, and add the keys of the truth, null, to a scene of a capture or a splat."""
        if not isinstance(raw, Mapping):
            return raw
        if raw.get("truth") == CONVERGED:
            raw = {**raw, "truth": {"grid": CONVERGED}}
        if isinstance(raw.get("splat"), str):
            raw = {**raw, "splat": {"file": raw["splat"]}}
        if raw.get("splat"):
            return {**OF_A_SPLAT, **raw}
        if raw.get("bodies"):
            raw = {**dict.fromkeys(OF_THE_TRUTH), "prior": "jelly", **raw}
        if not raw.get("captured"):
            return raw
        bodies = {name: {**dict.fromkeys(OF_THE_TRUTH), **own} for name, own in raw.get("bodies", {}).items()}
        return {**dict.fromkeys((*OF_THE_TRUTH, *OF_A_VIDEO)), **raw, "bodies": bodies}

    @model_validator(mode="after")
    def _truth_is_whole(self) -> Self:
        unknown = OF_A_SPLAT if self.splat else dict.fromkeys(OF_THE_TRUTH) if self.bodies else {}
        for key in (*OF_THE_TRUTH, *OF_A_VIDEO):
            if self.captured is None and getattr(self, key) is None and unknown.get(key, ...) is not None:
                raise ValueError(f"{key}: null is for scenes of captures only; give a value")
        if self.splat and self.captured:
            problem = "splat: this scene is one of a capture; give the scene of the splat another name"
            raise ValueError(problem)
        return self

    @model_validator(mode="after")
    def _bodies_are_whole(self) -> Self:
        if not self.bodies:
            if self.pairs:
                raise ValueError("pairs: need bodies")
            return self
        if not 2 <= len(self.bodies) <= MAX_BODIES:
            raise ValueError(f"bodies: {len(self.bodies)} must be 2 to {MAX_BODIES}")
        for name, body in self.bodies.items() if self.captured is None else ():
            for key in OF_THE_TRUTH:
                if getattr(body, key) is None:
                    raise ValueError(f"bodies.{name}.{key}: null is for captures only; give a value")
        others = [key for key in (*OF_THE_TRUTH, "splat") if getattr(self, key) is not None]
        others += [key for key in ("clamps", "videos") if getattr(self, key)]
        if others or self.images != SuppliedConfig():
            raise ValueError(f"{', '.join(others or ['images'])}: exclude bodies; leave them out")
        named = [frozenset(pair.bodies) for pair in self.pairs]
        if any(len(names) < 2 or not names <= set(self.bodies) for names in named):
            raise ValueError(f"pairs: each must name two of {', '.join(self.bodies)}")
        if len(set(named)) < len(named):
            raise ValueError("pairs: two entries are of the same bodies; remove one")
        return self

    @model_validator(mode="after")
    def _clamped_bodies_rest(self) -> Self:
        if self.clamps and any((*(self.velocity or ()), *self.spin)):
            raise ValueError("clamps: a clamped body starts at rest; set velocity and spin to [0, 0, 0]")
        return self

    @model_validator(mode="after")
    def _frames_ascend(self) -> Self:
        frames = self.frames
        if frames is not None and (
            list(frames) != sorted(set(frames))
            or not frames
            or frames[0] != 0
            or frames[-1] > (self.steps or 0)
        ):
            raise ValueError("frames: they must ascend from 0 to at most 'steps' without repeats")
        stride = self.images.stride
        for step in frames or () if stride else ():
            if step % stride:
                raise ValueError(f"frames: step {step} is not a multiple of images.stride = {stride}")
        return self
