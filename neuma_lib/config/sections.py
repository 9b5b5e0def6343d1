"""The sections of the settings: each key with its type, its default and one line that explains it.

Sections are data only; `neuma_lib.config.settings` puts them together and reads them from YAML. Hyper-parameters of an
optimisation stand beside its code; `block` makes sections of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from neuma_lib.config.blocks import Section, block

Vector = tuple[float, float, float]


def _numbers(part: Any) -> Any:
    """YAML 1.1 reads 1e5 as text: turn every constant of a law into a number, its name excepted."""
    if not isinstance(part, Mapping):
        raise ValueError("expected a mapping with a 'name' and the constants of the law")
    if "name" not in part:
        raise ValueError("the key 'name' is missing")
    return {k: str(v) if k == "name" else float(v) for k, v in part.items()}


LawPart = Annotated[dict[str, str | float], BeforeValidator(_numbers)]


class LawConfig(Section):
    """An analytic material: two named laws with their constants in SI units."""

    elasticity: LawPart = Field(
        description="name and constants of the elastic law, for example E [Pa] and nu"
    )
    plasticity: LawPart = Field({"name": "identity"}, description="name and constants of the return map")


class AppearanceConfig(Section):
    """What an object looks like in Blender."""

    kind: Literal["solid", "grains", "liquid"] = Field(
        "solid", description="textured mesh, grains, or a liquid's surface"
    )
    colors: dict[str, str] = Field(
        description="part of the shape -> sRGB colour '#rrggbb'; 'body' for all others"
    )
    accent: str = Field("", description="colour of the soft patches; empty: a darker shade of the part's own")
    contrast: float = Field(0.5, ge=0, le=1, description="strength of the patches")
    scale: float = Field(0.045, gt=0, description="size of the patches [m]")
    seed: int = Field(0, description="seed of the patches")


class SplitDensityConfig(Section):
    """Two mass densities on either side of a plane."""

    axis: Literal["x", "y", "z"] = Field("x", description="axis that the plane is normal to")
    at: float = Field(0.5, description="where the plane cuts the axis [m]")
    below: float = Field(gt=0, description="density on the side of smaller coordinates [kg/m^3]")
    above: float = Field(gt=0, description="density on the other side [kg/m^3]")


class SuppliedConfig(Section):
    """Image sets that were made elsewhere: a transforms.json, or a list in the layout of the authors' release."""

    static: str | None = Field(None, description="views at t = 0; null: rendered by Blender")
    dynamic: str | None = Field(
        None, description="videos with the frames that the scene's settings name; null: rendered by Blender"
    )


class SceneConfig(Section):
    """A benchmark: what is thrown, of what, how, and what is believed about it."""

    shape: str = Field(description="name of the shape: ball, duck, pawn, cat, bottle, fish or letter_X")
    size: float | None = Field(
        None, gt=0, description="longest side of the bounding box [m]; null: the shape's own"
    )
    height: float = Field(description="y of the bounding box's centre at the start [m]")
    center: tuple[float, float] = Field((0.5, 0.5), description="x and z of the bounding box's centre [m]")
    velocity: Vector = Field(description="initial velocity [m/s]")
    density: Annotated[float, Field(gt=0)] | SplitDensityConfig = Field(
        1000.0,
        description="mass density rho [kg/m^3], or two of them at t = 0: {axis: x, at: 0.5, below: 800, above: 1200}",
    )
    law: LawConfig = Field(description="the true material, known to the ground truth only")
    dt: float = Field(gt=0, description="time step [s]")
    steps: int = Field(gt=0, description="simulated steps of the video")
    frames: tuple[int, ...] | None = Field(
        None,
        description="steps of the video's frames, ascending from 0; null: as dataset.frames or dataset.stride say",
    )
    prior: str = Field(description="name in priors.laws, or path of a .safetensors or a released .pt file")
    appearance: AppearanceConfig = Field(description="how Blender shows it")
    images: SuppliedConfig = Field(
        SuppliedConfig(), description="files of its images, where Blender makes none"
    )
    story: str = Field("", description="in which way the prior is wrong, in words")
    material: dict[str, Any] = Field(
        {}, description="settings of the section material that this scene overrides"
    )

    @model_validator(mode="after")
    def _frames_ascend(self) -> SceneConfig:
        frames = self.frames
        if frames is not None and (
            list(frames) != sorted(set(frames)) or not frames or frames[0] != 0 or frames[-1] > self.steps
        ):
            raise ValueError("frames must ascend from 0 to at most 'steps' without repeats")
        return self


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

    @model_validator(mode="after")
    def _placed_only_with_a_shape(self) -> BodyConfig:
        placed = [key for key in ("size", "height", "center", "velocity") if getattr(self, key) is not None]
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


class ImagesConfig(Section):
    """One set of Blender renders."""

    views: int = Field(gt=0, description="number of cameras")
    width: int = Field(128, ge=8, description="image width [px]")
    height: int = Field(128, ge=8, description="image height [px]")
    samples: int = Field(16, ge=1, description="Cycles samples a pixel (denoised)")


class PackingConfig(Section):
    """How much of a ground truth travels in a packed dataset; all tracers do."""

    particles: int = Field(
        30_000,
        gt=0,
        description="particles kept, drawn at random, with volumes and masses scaled to the same total",
    )
    deformations: int = Field(1000, gt=0, description="those of them whose deformation gradient is kept")


class DatasetConfig(Section):
    """Ground truth and its images."""

    particles: int = Field(
        8000, gt=0, description="ground-truth particles, at least four times the reconstruction's"
    )
    seed: int = Field(1000, description="seed of the ground truth, apart from the reconstruction's")
    steps: int | None = Field(None, gt=0, description="steps of every video; null: those of its scene")
    frames: int | None = Field(
        25, ge=2, description="frames of a video, evenly from step 0 to the last, for scenes that list none"
    )
    stride: int | None = Field(
        None, ge=1, description="steps between two frames; in place of frames, which is null then"
    )
    tracers: int = Field(100_000, gt=0, description="passive tracers that measure the motion of the truth")
    static: ImagesConfig = Field(ImagesConfig(views=50), description="views on a sphere at t = 0")
    dynamic: ImagesConfig = Field(
        ImagesConfig(views=3, width=96, height=96), description="videos, view 0 frontal"
    )
    packed: str | None = Field(
        None,
        min_length=1,
        description="folder of packed datasets, `<scene>.images.zip` and `<scene>.truth.zip`, to unpack in place of "
        "simulating and rendering; null: the dataset is made here",
    )
    packing: PackingConfig = Field(PackingConfig(), description="what the target `packed` keeps")

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


class SimulationConfig(Section):
    """The material point method."""

    particles: int = Field(2000, gt=0, description="particles of the reconstructed body")
    grid: int = Field(24, ge=8, description="grid nodes along each side of the unit cube")
    gravity: Vector = Field((0.0, -9.8, 0.0), description="acceleration [m/s^2]")
    boundary: str | dict[str, str] = Field(
        "no_slip", description="condition of the walls: no_slip, slip or sticky, or one a wall (x_min, ...)"
    )
    wall_cells: int = Field(1, ge=1, description="thickness of the walls in cells")


RegressionConfig = block("fitting.priors", "RegressionSettings")
TrajectoryConfig = block("fitting.priors", "TrajectorySettings")


class PriorsConfig(Section):
    """Pre-trained neural constitutive laws."""

    laws: dict[str, LawConfig] = Field({}, description="analytic law that each prior is trained on, by name")
    method: Literal["regression", "trajectory"] = Field(
        "regression",
        description="regression on stress and return-map pairs, or NCLaw's training on trajectories",
    )
    seed: int = Field(0, description="seed of the data and of the initial weights")
    regression: RegressionConfig = Field(RegressionConfig(), description="the regression")
    trajectory: TrajectoryConfig = Field(TrajectoryConfig(), description="the training on trajectories")


GaussiansConfig = block("fitting.gaussians", "GaussianFitSettings")
SurfaceConfig = block("geometry.surface", "SurfaceSettings")


class GeometryConfig(Section):
    """Surface mesh and volume particles."""

    surface: SurfaceConfig = Field(SurfaceConfig(), description="reconstruction of the surface")
    sampling: Literal["jittered", "uniform"] = Field("jittered", description="how particles fill the volume")


class BindingConfig(Section):
    """Gaussian-particle binding (paper Algorithm 1)."""

    confidence: float = Field(0.95, gt=0, lt=1, description="tau of the chi-squared test")
    max_neighbours: int = Field(10, ge=1, description="nearest particles kept for a Gaussian")
    equal_mass: bool = Field(
        False, description="all particles, added ones too, share the volume equally (paper)"
    )


class VelocityConfig(Section):
    """Initial velocity from the frames before contact."""

    views: tuple[int, ...] = Field((0,), min_length=1, description="views of the video that are used")
    ridge: float = Field(
        0.0, ge=0, description="penalty on the depth axis, relative to the best determined axis"
    )
    initial_frames: int = Field(3, ge=2, description="frames of the first estimate")
    iterations: int = Field(30, ge=1, description="most Levenberg-Marquardt steps for a set of frames")
    difference: float = Field(0.02, gt=0, description="half width of the central differences [m/s]")


class MaterialChoices(Section):
    """Adaptation of the material law: what is trained, on what, how."""

    train: bool = Field(True, description="false: the prior as it is (NCLaw)")
    supervision: Literal["pixels", "particles"] = Field(
        "pixels", description="images, or ground-truth particles"
    )
    carrier: Literal["binding", "gaussians"] = Field(
        "binding", description="bound volume particles, or the Gaussians themselves as particles (w/o Bind)"
    )
    views: tuple[int, ...] = Field((0,), min_length=1, description="training views of the video")
    rank: int | None = Field(
        16, ge=1, description="rank of the adaptor; null trains the base weights (w/o dM)"
    )
    alpha: float = Field(16.0, gt=0, description="the adaptor's scale is alpha / rank")
    seed: int = Field(0, description="seed of the adaptor's initial weights")
    lr_scale: float = Field(1.0, gt=0, description="factor on both learning rates (sweeps, ablations)")
    covariance_gradient: bool = Field(True, description="let image gradients reach F through the covariances")
    covariance_from: Literal["elastic", "total"] = Field(
        "elastic",
        description="deformation that stretches the Gaussians: the elastic F (paper), or the total one, with all that "
        "has flowed",
    )
    assumed_density: float | None = Field(
        None, gt=0, description="density believed everywhere [kg/m^3]; null: the scene's is told"
    )


MaterialConfig = block("fitting.material", "MaterialSettings", base=MaterialChoices)


class EvaluationConfig(Section):
    """Rollout of the learned law and its measures."""

    tracers: int = Field(100_000, gt=0, description="passive tracers in the prediction")
    views: tuple[int, ...] | None = Field(
        None, min_length=1, description="views of the image metrics; null: those that training does not see"
    )
    margin: float = Field(
        0.1,
        ge=0,
        description="image metrics look at the bounding box of the object, observed and predicted, widened on each "
        "side by this fraction of its longer side",
    )
    video_view: int = Field(0, ge=0, description="view of the mp4 of prediction beside observation")
    frame_rate: int = Field(12, ge=1, description="frames a second of the mp4")
    video_magnify: int = Field(3, ge=1, description="enlargement of the mp4's pixels")


class FiguresConfig(Section):
    """What the figures show. Methods that a figure compares are those of tables.table1."""

    magnify: int = Field(
        3, ge=1, description="enlargement of the cameras of the videos for renders in figures"
    )
    size: int = Field(
        288,
        ge=32,
        description="width of pictures that have a camera of their own (experiments, particles) [px]",
    )
    view: int = Field(0, ge=0, description="view of the videos that is shown")
    shown: int = Field(
        5, ge=3, description="frames of a sequence, more in figures of one object, fewer of many"
    )
    main_res: tuple[str, ...] = Field(
        ("BouncyBall", "RubberPawn", "ClayCat"), min_length=1, description="scenes of the renders over time"
    )
    particles_app: str = Field("JellyDuck", description="scene whose particles are shown under all methods")
    lora_alphav: tuple[str, ...] = Field(
        ("BouncyBall", "RubberPawn"), min_length=1, description="scenes of the interpolation"
    )
    weights: tuple[float, ...] = Field(
        (0.0, 0.25, 0.5, 0.75, 1.0, 1.25), min_length=1, description="weights w of the adaptor, in order"
    )
    letters: tuple[str, ...] = Field((), description="experiments with one letter each, in order")
    meetings: tuple[str, ...] = Field((), description="experiments with several objects")
    ext_time: str = Field("", description="experiment that goes on after its scene's video ends")
    gradient_analysis: tuple[str, ...] = Field(
        ("BouncyBall", "RubberPawn"), min_length=1, description="scenes of the gradient norms"
    )
    pipeline: str = Field("ClayCat", description="scene that is shown through all stages")
    material_response: tuple[str, ...] = Field(
        ("BouncyBall", "JellyDuck", "RubberPawn", "ClayCat", "SandFish", "HoneyBottle"),
        min_length=1,
        description="scenes of the tests of material points",
    )
    shear_rate: float = Field(20.0, gt=0, description="rate of shear of the test of yielding [1/s]")
    total_shear: float = Field(0.6, gt=0, description="amount of shear that the test of yielding ends at")


class TableConfig(Section):
    """Rows and columns of a table of the paper."""

    scenes: tuple[str, ...] = Field((), description="columns, in order")
    experiments: tuple[str, ...] = Field((), description="columns after the scenes, in order")
    methods: tuple[str, ...] = Field((), description="rows, in order; variants such as neuma+rank=4 too")
    titles: dict[str, str] = Field({}, description="names of rows other than the methods' own, by method")
    seeds: int = Field(
        1,
        ge=1,
        description="runs of each method that draws an adaptor at random, as method+seed=k; with several, mean and "
        "standard deviation are shown",
    )

    @model_validator(mode="after")
    def _has_columns(self) -> TableConfig:
        if not self.scenes and not self.experiments:
            raise ValueError("give at least one scene or experiment, a column each")
        return self


class MethodConfig(Section):
    """A method is a set of options over the same code."""

    title: str = Field(description="name in tables")
    material: dict[str, Any] = Field(
        {}, description="settings of the section material that the method changes"
    )
