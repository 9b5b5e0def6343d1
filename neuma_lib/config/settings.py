"""All settings, and what they say of a scene, an experiment or a method: `Config`.

`neuma_lib.config.loading` makes one of the YAML that the user gave. Each stage has a module of its own beside this one,
so that what is computed again after an edit is what uses it. ``docs/settings.md`` is generated from all this by
`neuma_lib.config.page`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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
from neuma_lib.config.methods import IDENTIFIED, LAW_FROM, MethodConfig, parse_method, variant_title
from neuma_lib.config.pac_nerf import PacNerfConfig
from neuma_lib.config.photographs import PhotographsConfig
from neuma_lib.config.priors import PriorsConfig
from neuma_lib.config.radiance import RadianceConfig
from neuma_lib.config.random_scenes import RandomConfig
from neuma_lib.config.scenes import SceneConfig
from neuma_lib.config.simulation import GRAVITY, SimulationConfig
from neuma_lib.config.springs import SpringsConfig
from neuma_lib.config.structured import StructuredConfig
from neuma_lib.config.tables import TableConfig
from neuma_lib.config.validation import hint, validate
from neuma_lib.config.variants import DRAWN, folder, parse_chain
from neuma_lib.config.velocity import VelocityConfig
from neuma_lib.config.viewer import ViewerConfig
from neuma_lib.errors import InputError

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
    methods: dict[str, MethodConfig] = Field({}, description="methods by name")
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
        if IDENTIFIED in self.priors.laws:
            raise ValueError(
                f"priors.laws.{IDENTIFIED}: this names the law found in the video; choose another name"
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
        for name, method in self.methods.items():
            _changed(self.material, method.material, f"methods.{name}.material")
            _changed(self.structured, method.structured, f"methods.{name}.structured")
            _changed(self.springs, method.springs, f"methods.{name}.springs")
            _changed(self.pac_nerf, method.pac_nerf, f"methods.{name}.pac_nerf")
            self._known_prior(method.prior, f"methods.{name}.prior")
            own = [known for known, entry in self.methods.items() if entry.trained_as is None]
            if method.trained_as not in (None, *own):
                unknown = f"no method '{method.trained_as}' with a training of its own"
                raise ValueError(f"methods.{name}.trained_as: {unknown}{hint(method.trained_as, own)}")
            for key in (
                ("material", "structured", "springs", "pac_nerf", "prior") if method.trained_as else ()
            ):
                if getattr(method, key):
                    raise ValueError(
                        f"methods.{name}.{key}: that of '{method.trained_as}' counts; leave it out"
                    )
        for where, kind, name in self._mentioned():
            known = self.scenes if kind == "scene" else self.experiments
            if name not in known:
                raise ValueError(f"{where}: no {kind} '{name}'{hint(name, known)}")
        for name in self.experiments:
            self.experiment_truth(name)
        for method in self.random.methods if self.random.count else ():
            self._law_from(method)
        for method in (*self.figures.beside, *(self.demo.methods if "demo" in self.model_fields_set else ())):
            self._law_from(method)
        for table in self.tables.values():
            for method in (*table.methods, *table.titles):
                self._law_from(method)
        return self

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

    def true_law(self, scene: str, method: str) -> dict[str, Any] | None:
        """The true law of the scene, where this is what a method evaluates."""
        base, _ = parse_method(method, self.methods)
        if self.methods[base].law != "true":
            return None
        law = self.scene(self.law_scene(scene, method)).law
        if law is None:
            raise InputError(f"{scene}/{method}: {NO_TRUTH}")
        return law.plain()

    def is_identified(self, method: str) -> bool:
        """Whether a method evaluates the analytic law that was identified in the video."""
        return self.methods[parse_method(method, self.methods)[0]].law == "identified"

    def is_pac_nerf(self, method: str) -> bool:
        """Whether a method evaluates the analytic law, and the throw, that PAC-NeRF found in the video."""
        base, _ = parse_method(self.method_training(method), self.methods)
        return self.methods[base].law == "pac_nerf"

    def identified_views(self, scene: str, method: str) -> tuple[int, ...] | None:
        """Views that a method's law is identified in, if it trains on others than methods do by default; None: those
        of ``identify.views``."""
        views = self.method_material(scene, method).views
        return None if views in (self.material.views, self.identify.views) else views

    def is_structured(self, method: str) -> bool:
        """Whether a method's law is a structured correction of an analytic one."""
        base, _ = parse_method(self.method_training(method), self.methods)
        return self.methods[base].law == "structured"

    def is_springs(self, method: str) -> bool:
        """Whether a method moves the body by springs, and has no law of a material."""
        return self.methods[parse_method(method, self.methods)[0]].law == "springs"

    def video_scenes(self, name: str) -> list[str]:
        """Folders of the scenes whose videos the law of a scene is found in, in its chain: itself, then the others."""
        base, seeds = self.chain(name)
        return [name, *(folder(video, seeds) for video in self.scenes[base].videos)]

    def _law_from(self, method: str) -> str | None:
        """The scene whose law a variant evaluates everywhere; None: each scene's own."""
        source = parse_method(method, self.methods)[1].get(LAW_FROM)
        if source is not None and source not in self.scenes:
            raise InputError(f"{method}: no scene '{source}'{hint(source, self.scenes)}")
        return source

    def law_scene(self, scene: str, method: str) -> str:
        """Folder of the scene whose law a method evaluates on a scene, in its chain."""
        source = self._law_from(method)
        return scene if source is None else folder(source, self.chain(scene)[1])

    def learns_there(self, scene: str, method: str) -> bool:
        """Whether a method's law is found in the scene's own video: it is neither another's nor the prior alone."""
        trained = (
            self.method_material(scene, method).train
            or self.is_identified(method)
            or self.is_pac_nerf(method)
        )
        return self.law_scene(scene, method) == scene and (
            trained or self.true_law(scene, method) is not None
        )

    def gaussian_motion(self, scene: str, method: str) -> str:
        """How Gaussians follow their particles in a method, as `material.gaussian_motion`; those of a splat, of which
        many lie beside their particles, affinely."""
        return "affine" if self.scene(scene).splat else self.method_material(scene, method).gaussian_motion

    def moved_methods(self, scene: str, methods: Sequence[str]) -> list[str]:
        """What moves a scene where methods are asked for: these, and a splat, which has no video, instead of one that
        learns the same under the laws of ``figures.i23d``.

        Raises:
            InputError: a splat, and a method whose law cannot come from elsewhere.
        """
        if not self.scene(scene).splat:
            return list(methods)
        found = []
        for method in methods:
            if self.is_springs(method):
                raise InputError(
                    f"{scene}/{method}: a splat has no video to find springs in; leave this method out"
                )
            elsewhere = self.learns_there(scene, method)
            laws = self.figures.i23d if elsewhere else (None,)
            found += [f"{method}+{LAW_FROM}={law}" if law else method for law in laws]
        return list(dict.fromkeys(found))

    def method_density(self, scene: str, method: str) -> float | dict[str, Any]:
        """Density that a method takes the scene's body to have: the scene's, unless it assumes another."""
        assumed = self.method_material(scene, method).assumed_density
        return self.scene(scene).plain()["density"] if assumed is None else assumed

    def body_scenes(self, column: str) -> list[str]:
        """Folders of the scenes whose laws the bodies of a scene or experiment have, in its chain."""
        base, seeds = self.chain(column)
        if base in self.scenes:
            return [column]
        return [folder(body.scene, seeds) for body in self.experiments[base].bodies]

    def run_folder(self, column: str, method: str) -> str:
        """The one home, below the results' or the experiments' folder, of a method's run in a chain.

        Args:
            column: scene or experiment, or folder of a chain of it.
            method: method or variant. One that draws no adaptor is the same for all of its seeds.
        """
        base, seeds = self.chain(column)
        chosen = [self.method_material(scene, method) for scene in self.body_scenes(column)]
        random = self.is_structured(method)  # the first layers, whatever the rank
        adaptor = any(material.train and (material.rank is not None or random) for material in chosen)
        return f"{folder(base, seeds, DRAWN if adaptor else DRAWN[:-1])}/{method}"

    def runs(self, table: str, method: str, column: str) -> list[str]:
        """Folders of the runs behind a cell of a table, in the order of its chains, each once."""
        chosen = self.tables[table]
        chains = (folder(column, dict.fromkeys(chosen.vary, k)) for k in range(chosen.seeds))
        return list(dict.fromkeys(self.run_folder(chain, method) for chain in chains))

    def motion_clock(self, scene: str, method: str) -> tuple[float, tuple[int, ...]]:
        """Time step of a method's prediction of a splat [s], and the steps of its frames: those of the scene the law
        is from, since a law holds at the step it was learned at; the frames' times are the scene's."""
        dt, law_dt = self.scene(scene).dt, self.scene(self.law_scene(scene, method)).dt
        return law_dt, tuple(round(step * dt / law_dt) for step in self.frame_steps(scene))

    def frame_steps(self, name: str) -> tuple[int, ...]:
        """Steps of the frames of a scene's video. Raises InputError for a captured one, whose files tell them."""
        scene, steps = self.scene(name), self.dataset.steps or self.scene(name).steps
        if scene.captured:
            raise InputError(f"{name}: {NO_TRUTH}")
        if scene.frames is None and scene.images.stride is not None:
            return tuple(range(0, steps + 1, scene.images.stride))
        return scene.frames or self.dataset.frame_steps(steps)

    def method_title(self, method: str) -> str:
        """Name of a method or variant for tables, for example "NeuMA, rank 4"."""
        base, variant = parse_method(method, self.methods)
        return variant_title(self.methods[base].title, variant)

    def method_training(self, method: str) -> str:
        """The method or variant whose training gives a method's law: itself, unless it takes another's.

        In the scene that the law is from, `law_scene`.
        """
        base, *variant = (piece for piece in method.split("+") if not piece.startswith(f"{LAW_FROM}="))
        parse_method(method, self.methods)
        return "+".join([self.methods[base].trained_as or base, *variant])

    def judged_carrier(self, scene: str, method: str) -> str:
        """What is simulated when a method is judged, as in ``material.carrier``; or "field", see `carries_field`."""
        if self.carries_field(method):
            return "field"
        base, _ = parse_method(method, self.methods)
        carrier = self.methods[base].judged_on == "carrier"
        return self.method_material(scene, method).carrier if carrier else "binding"

    def carries_field(self, method: str) -> bool:
        """Whether a method is judged on the particles of PAC-NeRF's field, and shows what they carry."""
        base, _ = parse_method(method, self.methods)
        return self.methods[base].judged_on == "carrier" and self.is_pac_nerf(method)

    def method_note(self, method: str) -> str | None:
        """What a reader must know of a method's numbers, if anything."""
        base, _ = parse_method(method, self.methods)
        return self.methods[base].note

    def method_prior(self, scene: str, method: str) -> str:
        """The prior that a method starts from: the scene's, unless the method or its variant names another.

        `IDENTIFIED` is the law that was found in the scene's video.
        """
        base, variant = parse_method(self.method_training(method), self.methods)
        named = variant.get("prior", self.methods[base].prior)
        self._known_prior(named, method)
        return self.scene(self.law_scene(scene, method)).prior if named is None else named

    def _known_prior(self, prior: str | None, origin: str) -> None:
        known = [*self.priors.laws, IDENTIFIED]
        if prior is not None and prior not in known:
            raise InputError(
                f"{origin}: no prior '{prior}' in priors.laws{hint(prior, known)}; a law in a file is named as the "
                "prior of a scene"
            )

    def method_base(self, scene: str, method: str) -> dict[str, Any] | None:
        """The analytic law that a structured method corrects; None: the one that was found in the scene's video."""
        prior = self.method_prior(scene, method)
        if prior == IDENTIFIED:
            return None
        if prior not in self.priors.laws:
            raise InputError(
                f"{method} corrects an analytic law of priors.laws, or the one that was found in the video, and the "
                f"prior of {scene} is the file {prior}: take +prior={IDENTIFIED} or another of priors.laws, or neuma, "
                "which corrects the file's"
            )
        return self.priors.laws[prior].plain()

    def method_material(self, scene: str, method: str) -> MaterialConfig:
        """Effective material settings: the section, changed by the scene, then the method, then its variant.

        The scene is that of the law (`law_scene`). The seed of the scene's chain is added to the one that these give.

        Raises:
            InputError: a variant with settings of another kind of law, or a structured law without training.
        """
        base, variant = parse_method(self.method_training(method), self.methods)
        scene = self.law_scene(scene, method)
        for law in ("structured", "springs"):
            self._of_law(law, getattr(self, law), method)  # refuses settings that only those methods have
        section = self.material
        for changes, origin in (
            (self.scene(scene).material, f"scenes.{scene}.material"),
            (self.methods[base].material, f"methods.{base}.material"),
            ({key: value for key, value in variant.items() if key in MaterialConfig.model_fields}, method),
        ):
            section = _changed(section, changes, origin)
        if not section.train and self.is_structured(method):
            raise InputError(
                f"{method}: without training it is its analytic law; take a method with that law"
            )
        return section.model_copy(update={"seed": section.seed + self.chain(scene)[1]["adaptor"]})

    def method_structured(self, method: str) -> StructuredConfig | None:
        """Settings of a method's structured law: the section, changed by the method, then its variant; None without."""
        return self._of_law("structured", self.structured, method)

    def method_springs(self, method: str) -> SpringsConfig | None:
        """The same of a method with springs in place of a law, which are those of one body.

        Raises:
            InputError: also where the variant takes the springs of another scene.
        """
        found = self._of_law("springs", self.springs, method)
        if found and self._law_from(method):
            raise InputError(f"{method}: springs are those of the scene's own body; leave out {LAW_FROM}")
        return found

    def method_pac_nerf(self, method: str) -> PacNerfConfig | None:
        """The same of a method with PAC-NeRF's law."""
        return self._of_law("pac_nerf", self.pac_nerf, method)

    def _of_law(self, law: str, section: Changed, method: str) -> Changed | None:
        """Settings that only methods with one kind of law have."""
        base, variant = parse_method(self.method_training(method), self.methods)
        changes = {key: value for key, value in variant.items() if key in type(section).model_fields}
        if self.methods[base].law != law:
            if changes:
                raise InputError(f"{method}: its law is not {law}, leave out {', '.join(changes)}")
            return None
        section = _changed(section, getattr(self.methods[base], law), f"methods.{base}.{law}")
        return _changed(section, changes, method)


def _changed(section: Changed, changes: Mapping[str, Any], origin: str) -> Changed:
    return validate(type(section), {**section.plain(), **changes}, origin)
