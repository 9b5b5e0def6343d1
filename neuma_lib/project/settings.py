"""All settings, and what they say of a scene, an experiment or a method: `Config`.

`neuma_lib.project.loading` makes one of the YAML that the user gave. Each stage has a module of its own
beside this one,
so that what is computed again after an edit is what uses it. ``docs/settings.md`` is generated from all this by
`neuma_lib.project.page`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal, TypeVar

from pydantic import Field, model_validator

from neuma_lib.config.base import Section
from neuma_lib.config.binding import BindingConfig
from neuma_lib.config.capture import CapturesConfig
from neuma_lib.config.dataset import DatasetConfig, TruthConfig
from neuma_lib.config.demo import DemoConfig
from neuma_lib.config.evaluation import EvaluationConfig
from neuma_lib.config.experiments import ExperimentConfig
from neuma_lib.config.exports import ExportsConfig
from neuma_lib.config.figures import FiguresConfig
from neuma_lib.config.gaussians import GaussiansConfig
from neuma_lib.config.geometry import GeometryConfig
from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.material import MaterialConfig
from neuma_lib.config.photographs import PhotographsConfig
from neuma_lib.config.priors import PriorsConfig
from neuma_lib.config.scenes import SceneConfig
from neuma_lib.config.simulation import GRAVITY, SimulationConfig
from neuma_lib.config.structured import StructuredConfig
from neuma_lib.config.tables import TableConfig
from neuma_lib.config.validation import hint, validate
from neuma_lib.config.variants import folder, parse_chain
from neuma_lib.config.velocity import VelocityConfig
from neuma_lib.config.viewer import ViewerConfig
from neuma_lib.errors import InputError
from neuma_lib.methods.pac_nerf.field_options import RadianceConfig
from neuma_lib.methods.pac_nerf.options import PacNerfConfig
from neuma_lib.methods.registry import methods
from neuma_lib.methods.spring_gaus.options import SpringsConfig
from neuma_lib.project.methods import PresetConfig
from neuma_lib.project.random_scenes import RandomConfig

Changed = TypeVar("Changed", MaterialConfig, StructuredConfig, SpringsConfig, PacNerfConfig)

NO_TRUTH = (
    "nobody knows the truth of a captured object or a splat: ask for a result that needs none, see docs/capture.md and "
    "docs/splats.md"
)
TRUTH_DRAWS = ("the particles", "the tracers", "the second tracers")
"""What the seeds dataset.seed, dataset.seed + 1 and dataset.seed + 2 draw, see `neuma_lib.data.ground_truth`."""


class Config(Section):
    """All settings."""

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
    extensions: tuple[str, ...] = Field(
        (), description="Python files with own methods and laws, relative to the folder of the project"
    )
    scenes: dict[str, SceneConfig] = Field({}, description="benchmarks by name")
    random: RandomConfig = Field(RandomConfig(), description="scenes drawn at random, beside those by name")
    dataset: DatasetConfig = Field(DatasetConfig(), description="ground truth and images")
    simulation: SimulationConfig = Field(SimulationConfig(), description="material point method")
    priors: PriorsConfig = Field(PriorsConfig(), description="pre-trained laws")
    gaussians: GaussiansConfig = Field(GaussiansConfig(), description="static reconstruction")
    photographs: PhotographsConfig = Field(
        PhotographsConfig(), description="Gaussians and mesh of what was photographed"
    )
    radiance: RadianceConfig = Field(RadianceConfig(), description="voxel field of PAC-NeRF")
    geometry: GeometryConfig = Field(GeometryConfig(), description="mesh and particles")
    binding: BindingConfig = Field(BindingConfig(), description="Gaussians to particles")
    velocity: VelocityConfig = Field(VelocityConfig(), description="initial velocity")
    identify: IdentifyConfig = Field(IdentifyConfig(), description="family and constants of the material")
    material: MaterialConfig = Field(MaterialConfig(), description="adaptation of the law")
    structured: StructuredConfig = Field(
        StructuredConfig(), description="laws with the structure of a material"
    )
    springs: SpringsConfig = Field(SpringsConfig(), description="bodies of springs")
    pac_nerf: PacNerfConfig = Field(PacNerfConfig(), description="velocity and constants of PAC-NeRF")
    captures: CapturesConfig = Field(CapturesConfig(), description="own photographs and videos")
    evaluation: EvaluationConfig = Field(EvaluationConfig(), description="measures and videos")
    viewer: ViewerConfig = Field(ViewerConfig(), description="viewer in a file")
    exports: ExportsConfig = Field(ExportsConfig(), description="motions for other programs")
    figures: FiguresConfig = Field(FiguresConfig(), description="figures")
    demo: DemoConfig = Field(DemoConfig(), description="the first minute: `make demo`")
    methods: dict[str, PresetConfig] = Field(
        {}, description="presets of methods by name, besides the built-in"
    )
    experiments: dict[str, ExperimentConfig] = Field({}, description="uses of learned laws by name")
    tables: dict[str, TableConfig] = Field({}, description="tables by name")

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        """Names of scenes, experiments, priors and methods exist; what scenes and methods change fits its section."""
        for kind in ("scenes", "experiments", "methods", "priors.laws"):
            names = self.priors.laws if kind == "priors.laws" else getattr(self, kind)
            for name in names:
                if "+" in name or "/" in name:
                    raise ValueError(
                        f"{kind}.{name}: it names a folder, and + begins a variant; leave out + and /"
                    )
        if "identified" in self.priors.laws:
            raise ValueError(
                "priors.laws.identified: this name stands for the law identified in the video; choose another name"
            )
        for name in self.scenes.keys() & self.experiments.keys():
            raise ValueError(f"experiments.{name}: a scene has this name")
        for name, scene in self.scenes.items():
            if "/" not in scene.prior and "." not in scene.prior and scene.prior not in self.priors.laws:
                laws = self.priors.laws
                raise ValueError(
                    f"scenes.{name}.prior: no prior '{scene.prior}' in priors.laws{hint(scene.prior, laws)}"
                )
            _changed(self.material, scene.material, f"scenes.{name}.material")
            self.scene_truth(name)
            self._check_videos(name)
        for name in self.methods:
            self._check_preset(name)
        for where, kind, name in self._mentioned():
            known = self.scenes if kind == "scene" else self.experiments
            if name not in known:
                raise ValueError(f"{where}: no {kind} '{name}'{hint(name, known)}")
        for name in self.experiments:
            self.experiment_truth(name)
        return self

    def _check_preset(self, name: str) -> None:
        """The kind of a preset exists, and its options are those of the kind."""
        preset, where = self.methods[name], f"methods.{name}"
        if preset.same_fit_as is not None:
            own = [known for known, entry in self.methods.items() if entry.same_fit_as is None]
            if preset.same_fit_as not in own:
                unknown = f"no preset '{preset.same_fit_as}' with a fit of its own"
                raise ValueError(f"{where}.same_fit_as: {unknown}{hint(preset.same_fit_as, own)}")
            kind = self.methods[preset.same_fit_as].kind
            if preset.kind not in (None, kind):
                raise ValueError(
                    f"{where}.kind: it must be {kind}, as of '{preset.same_fit_as}'; leave it out"
                )
            return
        known = methods(self.extensions)
        if preset.kind not in known:
            raise ValueError(f"{where}.kind: no method '{preset.kind}'{hint(preset.kind, known)}")
        Options = known[preset.kind].Options
        sections = (getattr(self, section).plain() for section in known[preset.kind].sections)
        values = {
            key: value
            for section in sections
            for key, value in section.items()
            if key in Options.model_fields
        }
        options = validate(Options, values | preset.options, f"{where}.options")
        priors = (*self.priors.laws, "identified")
        if getattr(options, "prior", None) not in (None, *priors):
            raise ValueError(
                f"{where}.options.prior: no prior '{options.prior}' in priors.laws{hint(options.prior, priors)}"
            )

    def _check_videos(self, name: str) -> None:
        """Further videos of a scene are others, of its material, in its time step."""
        scene, where = self.scenes[name], f"scenes.{name}.videos"
        for video in scene.videos:
            if video not in self.scenes:
                raise ValueError(f"{where}: no scene '{video}'{hint(video, self.scenes)}")
            other, supplied = self.scenes[video], self.scenes[video].images.dynamic
            if video == name or scene.videos.count(video) > 1:
                raise ValueError(f"{where}: '{video}' is there twice; its own video a scene has anyway")
            if supplied is not None and supplied == scene.images.dynamic:
                raise ValueError(f"{where}: '{video}' has the same video, {supplied}; give it images.dynamic")
            if other.videos:
                raise ValueError(f"{where}: '{video}' has further videos itself; list all in one of the two")
            for key, why in (
                ("law", "one law is sought"),
                ("prior", "one law starts from one prior"),
                ("dt", "what a law lets flow in a step depends on it"),
            ):
                if getattr(other, key) != getattr(scene, key):
                    raise ValueError(f"{where}: '{video}' has another {key}, but {why}; give both the same")

    @model_validator(mode="after")
    def _floor_means_something(self) -> Config:
        """Truth and prediction are sampled alike, but independently: else the sampling floor is none of theirs."""
        if self.evaluation.tracers != self.dataset.tracers:
            raise ValueError(
                f"evaluation.tracers: {self.evaluation.tracers} in the prediction and dataset.tracers: "
                f"{self.dataset.tracers} in the truth: the sampling floor is that of equal counts, set both alike"
            )
        drawn = range(self.seed, self.seed + max((table.seeds for table in self.tables.values()), default=1))
        of_truth = {self.dataset.seed + k: what for k, what in enumerate(TRUTH_DRAWS)}
        for seed in of_truth.keys() & set(drawn):
            raise ValueError(
                f"dataset.seed: {self.dataset.seed} draws {of_truth[seed]} of the truth with the seed {seed}, "
                f"which the reconstruction has too (seed: {self.seed}, and the chains of tables.*.seeds after it): "
                "such samplings are not independent, move dataset.seed away"
            )
        return self

    def _mentioned(self) -> Iterator[tuple[str, str, str]]:
        """Where a scene or an experiment is mentioned: path of the key, "scene" or "experiment", name."""
        for name, experiment in self.experiments.items():
            for k, body in enumerate(experiment.bodies):
                yield f"experiments.{name}.bodies.{k}.scene", "scene", body.scene
        # The default figures show scenes of the benchmark: their names matter only where there are scenes.
        for key, kind in FiguresConfig.SHOWN.items():
            value = getattr(self.figures, key) if kind == "experiment" or self.scenes else ()
            for name in filter(None, [value] if isinstance(value, str) else value):
                yield f"figures.{key}", kind, name
        if self.scenes:
            yield "demo.scene", "scene", self.demo.scene
        for name, table in self.tables.items():
            for kind in ("scene", "experiment"):
                for column in getattr(table, f"{kind}s"):
                    yield f"tables.{name}.{kind}s", kind, column

    def chain(self, name: str) -> tuple[str, dict[str, int]]:
        """Base and seeds of the folder of a scene or an experiment, for example ``BouncyBall+seed=1``."""
        if name.partition("+")[0] in self.experiments:
            return parse_chain(name, self.experiments, "experiment")
        return parse_chain(name, self.scenes, "scene")

    def scene(self, name: str) -> SceneConfig:
        """The scene of that name, or of a chain's folder."""
        return self.scenes[parse_chain(name, self.scenes, "scene")[0]]

    @property
    def random_scenes(self) -> list[str]:
        """Names of the scenes drawn at random, in order."""
        drawn = (name for name in self.scenes if name.startswith(self.random.prefix))
        return [name for name in drawn if self.scenes[name].has_truth]

    @property
    def plain_scenes(self) -> list[str]:
        """Names of the scenes that have a truth, not one of their own fineness, and are neither drawn at random nor
        belong to tables on request alone."""
        asked, shown = (
            {
                scene
                for table in self.tables.values()
                if table.on_request == on_request
                for scene in table.scenes
            }
            for on_request in (True, False)
        )
        others = {
            *self.random_scenes,
            *(asked - shown),
            *(name for name, s in self.scenes.items() if not s.has_truth),
        }
        return [name for name, s in self.scenes.items() if name not in others and s.truth == TruthConfig()]

    def experiment(self, name: str) -> ExperimentConfig:
        """The experiment of that name, or of a chain's folder."""
        return self.experiments[parse_chain(name, self.experiments, "experiment")[0]]

    def experiment_bodies(self, name: str) -> list[dict[str, Any]]:
        """Complete plain descriptions of an experiment's bodies: those of their scenes, placed where it says.

        Each has ``scene``, and ``reconstructed`` for one that starts as the reconstruction of its scene's object.
        """
        found = []
        for body in self.experiment(name).bodies:
            scene = self.scene(body.scene).plain()
            keys = ("shape", "size", "height", "center", "velocity", "spin", "density", "law", "appearance")
            own = {key: value for key, value in body.plain().items() if value is not None}
            own |= {"size": body.size} if body.shape is not None else {}
            found.append({**{key: scene[key] for key in keys}, **own, "reconstructed": body.shape is None})
        return found

    def experiment_dt(self, name: str) -> float:
        """Time step of an experiment [s]."""
        experiment = self.experiment(name)
        return experiment.dt or min(self.scene(body.scene).dt for body in experiment.bodies)

    def scene_world(self, name: str) -> dict[str, Any]:
        """Grid and gravity of a scene's simulations: those of ``simulation``, or of the room of a capture."""
        captured = self.scene(name).captured
        if captured is None:
            return {"grid": self.simulation.grid, "gravity": list(self.simulation.gravity)}
        gravity = [0.0, -GRAVITY * captured.scale, 0.0]  # all lengths of the room are scaled
        return {"grid": captured.grid or self.captures.grid, "gravity": gravity}

    def scene_truth(self, name: str) -> TruthConfig:
        """How finely the ground truth of a scene is simulated, with nothing left open."""
        scene = self.scene(name)
        return self._truth(scene.truth, scene.dt, f"scenes.{name}")

    def experiment_truth(self, name: str) -> TruthConfig:
        """The same of an experiment, which has no settings of its own."""
        return self._truth(TruthConfig(), self.experiment_dt(name), f"experiments.{name}")

    def _truth(self, own: TruthConfig, dt: float, origin: str) -> TruthConfig:
        step = own.dt or self.dataset.dt or dt
        substeps = round(dt / step)
        if substeps < 1 or abs(dt / step - substeps) > 1e-6 * substeps:
            key = f"{origin}.truth.dt" if own.dt else "dataset.dt"
            raise InputError(
                f"{key}: a truth's frames are those of the reconstruction, so that {step:g} s must go evenly into its "
                f"time step, {dt:g} s in {origin}"
            )
        return TruthConfig(
            grid=own.grid or self.dataset.grid or self.simulation.grid,
            dt=step,
            particles=own.particles or self.dataset.particles,
        )

    def video_scenes(self, name: str) -> list[str]:
        """Folders of the scenes whose videos the law of a scene is found in, in its chain: itself, then the others."""
        base, seeds = self.chain(name)
        return [name, *(folder(video, seeds) for video in self.scenes[base].videos)]

    def body_scenes(self, column: str) -> list[str]:
        """Folders of the scenes whose laws the bodies of a scene or experiment have, in its chain."""
        base, seeds = self.chain(column)
        if base in self.scenes:
            return [column]
        return [folder(body.scene, seeds) for body in self.experiments[base].bodies]

    def frame_steps(self, name: str) -> tuple[int, ...]:
        """Steps of the frames of a scene's video. Raises InputError for a captured one, whose files tell them."""
        scene, steps = self.scene(name), self.dataset.steps or self.scene(name).steps
        if scene.captured:
            raise InputError(f"{name}: {NO_TRUTH}")
        if scene.frames is None and scene.images.stride is not None:
            return tuple(range(0, steps + 1, scene.images.stride))
        return scene.frames or self.dataset.frame_steps(steps)


def _changed(section: Changed, changes: Mapping[str, Any], origin: str) -> Changed:
    return validate(type(section), {**section.plain(), **changes}, origin)
