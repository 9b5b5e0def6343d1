"""Typed settings of the whole pipeline: one home, one type, one default and one line of explanation each.

`load` turns the merged YAML that the user gave into a `Config`; unknown keys, wrong types and impossible values are
an `InputError` that names the key by its path. Sections are data only, and a stage receives the complete section
(all defaults filled in) as plain numbers. Hyper-parameters of an optimisation stand beside its code; `block` makes
sections of them.

``docs/settings.md`` is generated from this file by `neuma_lib.settings_page`.
"""

from __future__ import annotations

import copy
import difflib
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, BeforeValidator, Field, ValidationError, model_validator

from neuma_lib.errors import InputError
from neuma_lib.settings_blocks import Section, block

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


class Config(Section):
    """Everything."""

    data_root: str = Field("data", description="folder of generated or supplied inputs")
    results_root: str = Field("results", description="folder of everything computed")
    kernel_cache: str = Field(".cache/warp", description="folder of compiled Warp kernels")
    scenes_file: str = Field(
        "config/scenes.yaml", description="table of the scenes; 'scenes' overrides parts of it"
    )
    device: Literal["auto", "cpu", "cuda"] = Field(
        "auto", description="where to compute; auto: CUDA if there is one"
    )
    seed: int = Field(0, description="seed of every stage that has none of its own")
    scenes: dict[str, SceneConfig] = Field({}, description="benchmarks by name")
    dataset: DatasetConfig = Field(DatasetConfig(), description="ground truth and images")
    simulation: SimulationConfig = Field(SimulationConfig(), description="material point method")
    priors: PriorsConfig = Field(PriorsConfig(), description="pre-trained laws")
    gaussians: GaussiansConfig = Field(GaussiansConfig(), description="static reconstruction")
    geometry: GeometryConfig = Field(GeometryConfig(), description="mesh and particles")
    binding: BindingConfig = Field(BindingConfig(), description="Gaussians to particles")
    velocity: VelocityConfig = Field(VelocityConfig(), description="initial velocity")
    material: MaterialConfig = Field(MaterialConfig(), description="adaptation of the law")
    evaluation: EvaluationConfig = Field(EvaluationConfig(), description="measures and videos")
    figures: FiguresConfig = Field(FiguresConfig(), description="figures")
    methods: dict[str, MethodConfig] = Field({}, description="methods by name")
    experiments: dict[str, ExperimentConfig] = Field({}, description="uses of learned laws by name")
    tables: dict[str, TableConfig] = Field({}, description="tables by name")

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        for name, scene in self.scenes.items():
            if "/" not in scene.prior and "." not in scene.prior and scene.prior not in self.priors.laws:
                raise ValueError(
                    f"scenes.{name}.prior: no prior '{scene.prior}' in priors.laws"
                    + _close(scene.prior, self.priors.laws)
                )
            _overridden(self.material, scene.material, f"scenes.{name}.material")
        for name, method in self.methods.items():
            _overridden(self.material, method.material, f"methods.{name}.material")
        for name, experiment in self.experiments.items():
            for k, body in enumerate(experiment.bodies):
                if body.scene not in self.scenes:
                    where = f"experiments.{name}.bodies.{k}.scene"
                    raise ValueError(f"{where}: no scene '{body.scene}'{_close(body.scene, self.scenes)}")
        self._check_figures()
        for name, table in self.tables.items():
            for kind, known in (("scenes", self.scenes), ("experiments", self.experiments)):
                for column in getattr(table, kind):
                    if column not in known:
                        where = f"tables.{name}.{kind}"
                        raise ValueError(f"{where}: no {kind[:-1]} '{column}'{_close(column, known)}")
            for method in (*table.methods, *table.titles):
                parse_method(method, self.methods)
        return self

    def _check_figures(self) -> None:
        """That what figures show exists; names of scenes matter only where there are scenes."""
        drawn = self.figures
        scenes = {
            "particles_app": [drawn.particles_app],
            "pipeline": [drawn.pipeline],
            **{key: getattr(drawn, key) for key in ("main_res", "lora_alphav")},
            **{key: getattr(drawn, key) for key in ("gradient_analysis", "material_response")},
        }
        experiments = {
            "letters": drawn.letters,
            "meetings": drawn.meetings,
            "ext_time": [drawn.ext_time] if drawn.ext_time else [],
        }
        for chosen, known, kind in (
            (scenes if self.scenes else {}, self.scenes, "scene"),
            (experiments, self.experiments, "experiment"),
        ):
            for key, names in chosen.items():
                for name in names:
                    if name not in known:
                        raise ValueError(f"figures.{key}: no {kind} '{name}'{_close(name, known)}")

    def scene(self, name: str) -> SceneConfig:
        """The scene of that name."""
        if name not in self.scenes:
            raise InputError(f"no scene '{name}' in {self.scenes_file}{_close(name, self.scenes)}")
        return self.scenes[name]

    def experiment(self, name: str) -> ExperimentConfig:
        """The experiment of that name."""
        if name not in self.experiments:
            raise InputError(f"no experiment '{name}'{_close(name, self.experiments)}")
        return self.experiments[name]

    def experiment_bodies(self, name: str) -> list[dict[str, Any]]:
        """Complete plain descriptions of an experiment's bodies: those of their scenes, placed where it says.

        Each has ``scene``, and ``reconstructed`` for one that starts as the reconstruction of its scene's object.
        """
        found = []
        for body in self.experiment(name).bodies:
            scene = self.scene(body.scene).plain()
            keys = ("shape", "size", "height", "center", "velocity", "density", "law", "appearance")
            own = {key: value for key, value in body.plain().items() if value is not None}
            own |= {"size": body.size} if body.shape is not None else {}
            found.append({**{key: scene[key] for key in keys}, **own, "reconstructed": body.shape is None})
        return found

    def experiment_dt(self, name: str) -> float:
        """Time step of an experiment [s]."""
        experiment = self.experiment(name)
        return experiment.dt or min(self.scene(body.scene).dt for body in experiment.bodies)

    def method_density(self, scene: str, method: str) -> float | dict[str, Any]:
        """Density that a method takes the scene's body to have: the scene's, unless it assumes another."""
        assumed = self.method_material(scene, method).assumed_density
        return self.scene(scene).plain()["density"] if assumed is None else assumed

    def seeded(self, table: str, method: str, scene: str) -> list[str]:
        """The runs behind a cell of a table: the method itself, and variants of other seeds if it has several."""
        material = self.method_material(scene, method)
        random = material.train and material.rank is not None
        others = range(1, self.tables[table].seeds) if random else ()
        return [method, *(f"{method}+seed={k}" for k in others)]

    def frame_steps(self, name: str) -> tuple[int, ...]:
        """Steps of the frames of a scene's video."""
        scene = self.scene(name)
        return scene.frames or self.dataset.frame_steps(self.dataset.steps or scene.steps)

    def method_title(self, method: str) -> str:
        """Name of a method or variant for tables, for example "NeuMA, rank 4"."""
        base, variant = parse_method(method, self.methods)
        return ", ".join([self.methods[base].title, *(f"{k} {_scalar_text(v)}" for k, v in variant.items())])

    def method_prior(self, scene: str, method: str) -> str:
        """The prior that a method starts from: the scene's, unless the variant names another."""
        _, variant = parse_method(method, self.methods)
        prior = str(variant.get("prior", self.scene(scene).prior))
        if "prior" in variant and prior not in self.priors.laws:
            raise InputError(f"{method}: no prior '{prior}' in priors.laws{_close(prior, self.priors.laws)}")
        return prior

    def method_material(self, scene: str, method: str) -> MaterialConfig:
        """Effective material settings: the section, changed by the scene, then the method, then its variant."""
        base, variant = parse_method(method, self.methods)
        variant.pop("prior", None)
        section = self.material
        for changes, origin in (
            (self.scene(scene).material, f"scenes.{scene}.material"),
            (self.methods[base].material, f"methods.{base}.material"),
            (variant, method),
        ):
            section = _overridden(section, changes, origin)
        return section


def parse_method(text: str, methods: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Split a method's folder name, ``neuma+rank=4+seed=2``, into its base and its settings.

    Keys are those of the section ``material``, and ``prior``. Values are YAML scalars; a comma makes a list.

    Raises:
        InputError: unknown method or key, a repeated key, or a piece without '='.
    """
    base, *pieces = text.split("+")
    if base not in methods:
        raise InputError(f"no method '{base}'{_close(base, methods)}")
    variant: dict[str, Any] = {}
    known = [*MaterialConfig.model_fields, "prior"]
    for piece in pieces:
        key, equals, value = piece.partition("=")
        if not equals or not key or not value:
            raise InputError(f"method '{text}': write variants as +key=value, not '+{piece}'")
        if key not in known:
            raise InputError(f"method '{text}': no setting '{key}'{_close(key, known)}")
        if key in variant:
            raise InputError(f"method '{text}': '{key}' is given twice")
        kind = typing.get_origin(MaterialConfig.model_fields[key].annotation) if key != "prior" else None
        values = [yaml.safe_load(v) for v in value.split(",")]
        variant[key] = values if kind is tuple else yaml.safe_load(value)
    return base, variant


def load(raw: Mapping[str, Any], root: str | Path = ".") -> Config:
    """Validate merged settings.

    Args:
        raw: the YAML as nested dicts. ``scenes_file`` (relative to ``root``) is read, and ``scenes`` changes it.
        root: folder of the project.

    Raises:
        InputError: names every offending key by its path and suggests close matches.
    """
    raw = copy.deepcopy(dict(raw))
    scenes_file = Path(root) / str(raw.get("scenes_file", Config.model_fields["scenes_file"].default))
    scenes = read_yaml(scenes_file)
    raw["scenes"] = merged(scenes, raw.get("scenes") or {})
    return validate(Config, raw)


def validate(kind: type, raw: Any, origin: str = "") -> Any:
    """Build a section, with errors that name keys by their path below ``origin``."""
    try:
        return kind.model_validate(raw)
    except ValidationError as error:
        lines = [_explain(kind, problem, origin) for problem in error.errors()]
        raise InputError("settings: " + "\n          ".join(lines)) from None


def read_yaml(path: str | Path) -> dict[str, Any]:
    """A YAML file as a dict. Raises InputError naming the file when it is missing or not a mapping."""
    try:
        content = yaml.safe_load(Path(path).read_text())
    except FileNotFoundError:
        raise InputError(f"{path} does not exist: give the path of an existing settings file") from None
    except yaml.YAMLError as error:
        raise InputError(f"{path} is not valid YAML: {error}") from None
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise InputError(f"{path} must hold 'key: value' lines, not a {type(content).__name__}")
    return content


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with ``changes`` laid over it, nested dicts merged, everything else replaced."""
    result = dict(base)
    for key, value in changes.items():
        old = result.get(key)
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        result[key] = merged(old, value) if both else value
    return result


def pick(kind: type, section: Section | Mapping[str, Any], **others: Any) -> Any:
    """Build the dataclass ``kind`` from the fields of the same names; ``others`` are given by hand."""
    values = (
        section
        if isinstance(section, Mapping)
        else {k: getattr(section, k) for k in type(section).model_fields}
    )
    return kind(
        **{f.name: values[f.name] for f in fields(kind) if f.name in values and f.name not in others},
        **others,
    )


def from_mapping(kind: type, values: Mapping[str, Any], origin: str) -> Any:
    """Build the dataclass ``kind`` from a block of settings, blocks inside it too; lists become tuples.

    Raises:
        InputError: an unknown key, named by its path below ``origin``.
    """
    known = {f.name: f for f in fields(kind)}
    built = {}
    for key, value in values.items():
        if key not in known:
            raise InputError(f"settings: {origin}.{key}: unknown key{_close(key, known)}")
        if isinstance(value, Mapping) and is_dataclass(known[key].default):
            value = from_mapping(type(known[key].default), value, f"{origin}.{key}")
        built[key] = tuple(value) if isinstance(value, list) else value
    return kind(**built)


def _overridden(section: MaterialConfig, changes: Mapping[str, Any], origin: str) -> MaterialConfig:
    return validate(type(section), merged(section.plain(), changes), origin)


def _close(word: str, known: Any) -> str:
    """A hint: the close matches, or all that there is."""
    matches = difflib.get_close_matches(str(word), [str(k) for k in known], n=2, cutoff=0.6)
    if matches:
        return f"; did you mean {' or '.join(matches)}?"
    return f"; known: {', '.join(map(str, known))}" if known else ""


def _scalar_text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _explain(kind: type, problem: Mapping[str, Any], origin: str) -> str:
    where = [str(p) for p in problem["loc"]]
    path = ".".join([origin, *where] if origin else where)
    if problem["type"] == "extra_forbidden":
        siblings = _keys_at(kind, problem["loc"][:-1])
        return f"{path}: unknown key{_close(where[-1], siblings)}"
    if problem["type"] == "missing":
        return f"{path}: this key is missing"
    message = problem["msg"].removeprefix("Value error, ").removeprefix("settings: ")
    if not path:
        return message
    given = problem.get("input")
    return f"{path}: {message}" + (f" (given: {given!r})" if not isinstance(given, Mapping) else "")


def _keys_at(kind: type, where: tuple) -> list[str]:
    """Keys of the section at a path, for suggestions."""
    for step in where:
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            if step not in kind.model_fields:
                return []
            kind = kind.model_fields[step].annotation
        elif typing.get_origin(kind) is dict:
            kind = typing.get_args(kind)[1]
        else:
            return []
    return list(kind.model_fields) if isinstance(kind, type) and issubclass(kind, BaseModel) else []
