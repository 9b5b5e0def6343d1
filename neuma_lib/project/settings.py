"""All settings: `Config` combines the sections, and answers what they mean for a scene or an experiment.

`neuma_lib.project.loading` builds it from YAML and checks that sections agree (`neuma_lib.project.consistency`).
"""

import math
from collections.abc import Sequence
from typing import Any, Literal

from pydantic import Field

from neuma_lib.config.base import Section, Seed
from neuma_lib.config.binding import BindingConfig
from neuma_lib.config.capture import CapturesConfig
from neuma_lib.config.dataset import CONVERGED, DatasetConfig, TruthConfig
from neuma_lib.config.demo import DemoConfig
from neuma_lib.config.evaluation import EvaluationConfig
from neuma_lib.config.experiments import ExperimentConfig
from neuma_lib.config.exports import ExportsConfig
from neuma_lib.config.figures import FiguresConfig
from neuma_lib.config.gaussians import GaussiansConfig
from neuma_lib.config.geometry import GeometryConfig
from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.next import NextConfig
from neuma_lib.config.obstacles import ColliderConfig
from neuma_lib.config.photographs import PhotographsConfig
from neuma_lib.config.priors import PriorsConfig
from neuma_lib.config.scenes import PairConfig, SceneConfig
from neuma_lib.config.simulation import GRAVITY, SimulationConfig
from neuma_lib.config.specimens import SpecimenConfig
from neuma_lib.config.stills import StillsConfig
from neuma_lib.config.structured import StructuredConfig
from neuma_lib.config.tables import TableConfig
from neuma_lib.config.training import TrainingConfig
from neuma_lib.config.variants import parse_replicate, replicate_folder
from neuma_lib.config.velocity import VelocityConfig
from neuma_lib.config.viewer import ViewerConfig
from neuma_lib.errors import InputError
from neuma_lib.methods.pac_nerf.field_options import RadianceConfig
from neuma_lib.methods.pac_nerf.options import PacNerfConfig
from neuma_lib.methods.spring_gaus.options import SpringsConfig
from neuma_lib.project.methods import PresetConfig
from neuma_lib.project.random_scenes import RandomConfig

NO_TRUTH = "the true law and motion of a captured object, a splat, or each of several bodies are unknown"


class Config(Section):
    """All settings."""

    data_root: str = Field("data", description="folder of generated or supplied inputs")
    results_root: str = Field("results", description="folder of all computed files")
    kernel_cache: str = Field(".cache/warp", description="folder of compiled Warp kernels")
    scenes_file: str = Field(
        "config/scenes.yaml", description="table of the scenes, which `scenes` overrides"
    )
    device: Literal["auto", "cpu", "cuda"] = Field(
        "auto", description="device of all computations; auto: CUDA if there is a GPU"
    )
    seed: Seed = Field(0, description="seed of every stage without its own seed")
    extensions: tuple[str, ...] = Field(
        (), description="Python files with own methods and laws, relative to the folder of the project"
    )
    scenes: dict[str, SceneConfig] = Field({}, description="scenes by name")
    random: RandomConfig = Field(RandomConfig(), description="random scenes")
    dataset: DatasetConfig = Field(DatasetConfig(), description="ground truth and images")
    simulation: SimulationConfig = Field(SimulationConfig(), description="material point method")
    priors: PriorsConfig = Field(PriorsConfig(), description="pre-trained laws")
    gaussians: GaussiansConfig = Field(GaussiansConfig(), description="static reconstruction")
    photographs: PhotographsConfig = Field(PhotographsConfig(), description="reconstruction from photographs")
    radiance: RadianceConfig = Field(RadianceConfig(), description="voxel field of PAC-NeRF")
    geometry: GeometryConfig = Field(GeometryConfig(), description="mesh and particles")
    binding: BindingConfig = Field(BindingConfig(), description="Gaussians to particles")
    velocity: VelocityConfig = Field(VelocityConfig(), description="initial velocity")
    identify: IdentifyConfig = Field(IdentifyConfig(), description="family and constants of the material")
    next: NextConfig = Field(NextConfig(), description="choice of the next experiment")
    training: TrainingConfig = Field(TrainingConfig(), description="adaptation of the law")
    structured: StructuredConfig = Field(
        StructuredConfig(), description="laws with the structure of a material"
    )
    springs: SpringsConfig = Field(SpringsConfig(), description="bodies of springs")
    pac_nerf: PacNerfConfig = Field(PacNerfConfig(), description="velocity and constants of PAC-NeRF")
    captures: CapturesConfig = Field(CapturesConfig(), description="own photographs and videos")
    stills: StillsConfig = Field(StillsConfig(), description="bodies at rest in photographs")
    evaluation: EvaluationConfig = Field(EvaluationConfig(), description="measures and videos")
    viewer: ViewerConfig = Field(ViewerConfig(), description="viewer in a file")
    exports: ExportsConfig = Field(ExportsConfig(), description="motions for other programs")
    figures: FiguresConfig = Field(FiguresConfig(), description="figures")
    demo: DemoConfig = Field(DemoConfig(), description="the demo, `make demo`")
    methods: dict[str, PresetConfig] = Field(
        {}, description="presets of methods by name, in addition to the built-in"
    )
    experiments: dict[str, ExperimentConfig] = Field({}, description="uses of learned laws by name")
    specimens: dict[str, SpecimenConfig] = Field({}, description="tests on clamped beams by name")
    tables: dict[str, TableConfig] = Field({}, description="tables by name")

    def replicate(self, name: str) -> tuple[str, dict[str, int]]:
        """Base and seeds of the folder of a scene or an experiment, for example ``BouncyBall+seed=1``."""
        if name.partition("+")[0] in self.experiments:
            return parse_replicate(name, self.experiments, "experiment")
        return parse_replicate(name, self.scenes, "scene")

    def scene(self, name: str) -> SceneConfig:
        """The scene of a name or of the folder of a replicate."""
        return self.scenes[parse_replicate(name, self.scenes, "scene")[0]]

    def is_own_capture(self, name: str) -> bool:
        """Whether a scene is one of a capture in the folder of captures."""
        captured = self.scene(name).captured
        return captured is not None and captured.capture not in self.captures.released

    @property
    def random_scenes(self) -> list[str]:
        """Names of the scenes of one body drawn at random, in order."""
        return [name for name in self._drawn if self.scenes[name].has_truth and not self.scenes[name].part_of]

    @property
    def random_piles(self) -> list[str]:
        """Names of the scenes of several bodies drawn at random, in order."""
        return [name for name in self._drawn if self.scenes[name].bodies]

    @property
    def _drawn(self) -> list[str]:
        return [name for name in self.scenes if name.startswith(self.random.prefix)]

    @property
    def plain_scenes(self) -> list[str]:
        """Names of the scenes with a truth of default resolution, without random ones, those of optional tables, and
        bodies of a scene of several."""
        in_tables: dict[bool, set[str]] = {True: set(), False: set()}
        for table in self.tables.values():
            in_tables[table.default_target].update(table.scenes)
        excluded = {*self.random_scenes, *(in_tables[False] - in_tables[True])}
        return [
            name
            for name, scene in self.scenes.items()
            if scene.has_truth and scene.truth == TruthConfig() and not scene.part_of and name not in excluded
        ]

    def experiment(self, name: str) -> ExperimentConfig:
        """The experiment of a name or of the folder of a replicate."""
        return self.experiments[parse_replicate(name, self.experiments, "experiment")[0]]

    def experiment_bodies(self, name: str) -> list[dict[str, Any]]:
        """Complete plain descriptions of the bodies of an experiment, with the settings of their scenes.

        Each has ``scene``, and ``reconstructed``: whether it is the reconstructed object of its scene.
        """
        bodies = []
        for body in self.experiment(name).bodies:
            scene = self.scene(body.scene).plain()
            keys = ("shape", "size", "height", "center", "velocity", "spin", "density", "law", "appearance")
            rotation = scene["rotation"] if body.shape is None else [0.0, 0.0, 0.0]
            own = {key: value for key, value in body.plain().items() if value is not None}
            own |= {"size": body.size} if body.shape is not None else {}
            whole = {**{key: scene[key] for key in keys}, "rotation": rotation, **own}
            bodies.append({**whole, "reconstructed": body.shape is None})
        return bodies

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

    def obstacles(self, name: str) -> dict[str, Any]:
        """Plain arguments of `neuma_lib.io.simulator.simulator` of a scene or an experiment with obstacles or friction.

        The faces of the cube have the friction of the scene, in an experiment of the first body's.
        """
        base, _ = self.replicate(name)
        experiment = self.experiments.get(base)
        lists = {"colliders": self.colliders(name)[1], "clamps": (experiment or self.scenes[base]).clamps}
        plain = {key: [each.arguments() for each in entries] for key, entries in lists.items() if entries}
        friction = self.scenes[experiment.bodies[0].scene if experiment else base].friction
        plain |= {} if friction is None else {"boundary": friction}
        pile, bodies = self.touching_bodies(name)
        pairs = self.scenes[pile].pairs if pile and len(bodies) > 1 else ()
        if plain_pairs := [_pair_arguments(pair, bodies) for pair in pairs if {*pair.bodies} <= {*bodies}]:
            plain["pairs"] = plain_pairs
        touches = plain.keys() & {"colliders", "boundary"} or pile
        return plain | ({"contact": "particles"} if touches else {})

    def touching_bodies(self, name: str) -> tuple[str | None, list[str]]:
        """The scene of several bodies that the bodies of a scene or an experiment are from, and their names there.

        (None, []) for other bodies, which stick where they touch.
        """
        base, _ = self.replicate(name)
        if base in self.scenes and self.scenes[base].bodies:
            return base, list(self.scenes[base].bodies)
        own = self.experiments[base].bodies if base in self.experiments else ()
        parts = [self.scenes[body.scene].part_of for body in own] if own else [self.scenes[base].part_of]
        piles = {part[0] if part else None for part in parts}
        names = [part[1] for part in parts if part]
        if len(piles) > 1 or None in piles or len({*names}) < len(names):
            return None, []
        return piles.pop(), names

    def scene_bodies(self, name: str) -> list[dict[str, Any]]:
        """Plain descriptions of the bodies of a scene: the scene itself, or those of several.

        Each of several has its ``name``, its own ``scene``, and ``reconstructed``, as of `experiment_bodies`.
        """
        scene = self.scene(name)
        several = zip(self.body_scenes(name), scene.bodies.items(), strict=False)
        bodies = [
            {"name": key, "scene": own, "reconstructed": True, **body.plain()} for own, (key, body) in several
        ]
        return bodies or [scene.plain()]

    def colliders(self, name: str) -> tuple[str, tuple[ColliderConfig, ...]]:
        """Path of the key with the colliders of a scene or an experiment, and them."""
        base, _ = self.replicate(name)
        if base in self.experiments:
            own = self.experiments[base]
            if own.colliders is not None:
                return f"experiments.{base}.colliders", own.colliders
            base = own.bodies[0].scene
        return f"scenes.{base}.colliders", self.scenes[base].colliders

    def scene_truth(self, name: str) -> TruthConfig:
        """Resolution of the ground truth of a scene. Only the particles of a converged truth may be null."""
        scene = self.scene(name)
        return self._truth(scene.truth, scene.dt, f"scenes.{name}")

    def experiment_truth(self, name: str) -> TruthConfig:
        """Resolution of the ground truth of an experiment, converged if that of a scene of its bodies is."""
        scenes = [self.scene(body.scene) for body in self.experiment(name).bodies]
        converged = any(scene.truth.grid == CONVERGED for scene in scenes)
        own = TruthConfig(grid=CONVERGED if converged else None)
        return self._truth(own, self.experiment_dt(name), f"experiments.{name}")

    def _truth(self, own: TruthConfig, dt: float, origin: str) -> TruthConfig:
        grid = own.grid or self.dataset.grid or self.simulation.grid
        if grid == CONVERGED:
            cells = max(self.dataset.converged_grid, 2 * self.simulation.grid)
            # A truth of half the grid takes half as many steps.
            factor = 2 * math.ceil(cells / (2 * self.simulation.grid))
            return TruthConfig(grid=cells, dt=own.dt or dt / factor, particles=own.particles)
        step = own.dt or self.dataset.dt or dt
        substeps = round(dt / step)
        if substeps < 1 or abs(dt / step - substeps) > 1e-6 * substeps:
            key = f"{origin}.truth.dt" if own.dt else "dataset.dt"
            problem = f"{step:g} s is not an integer fraction of the time step {dt:g} s of {origin}"
            raise InputError(key, problem)
        return TruthConfig(grid=grid, dt=step, particles=own.particles or self.dataset.particles)

    def video_scenes(self, name: str) -> list[str]:
        """Folders of the scenes whose videos train the law of a scene, in its replicate: itself, then the others."""
        base, seeds = self.replicate(name)
        return [name, *(replicate_folder(video, seeds) for video in self.scenes[base].videos)]

    def identify_of(self, name: str) -> IdentifyConfig:
        """Settings of the identification of a scene, in its replicate.

        A truth that was simulated on the grid of `simulation` has no limit for smaller cells. Identification of such
        a scene uses the refined particles on the same grid.

        Raises:
            InputError: the finer grid would not have more particles than `geometry.particles`.
        """
        refined, own = self.identify.refined_particles, self.geometry.particles
        if 0 < refined <= own:
            raise InputError(
                "identify.refined_particles",
                f"{refined} must exceed geometry.particles = {own}",
                f"Set it to {4 * own}, or to 0 to disable the discretisation correction",
            )
        videos = [self.replicate(video)[0] for video in self.video_scenes(name)]
        shared = any(
            self.scene(video).has_truth and self.scene_truth(video).grid == self.simulation.grid
            for video in videos
        )
        return self.identify.model_copy(update={"refinement": 1.0}) if shared else self.identify

    def body_scenes(self, column: str) -> list[str]:
        """Folders of the scenes whose laws the bodies of a scene or experiment have, in its replicate."""
        base, seeds = self.replicate(column)
        if base in self.scenes:
            parts = [replicate_folder(f"{base}_{body}", seeds) for body in self.scenes[base].bodies]
            return parts or [column]
        return [replicate_folder(body.scene, seeds) for body in self.experiments[base].bodies]

    def frame_steps(self, name: str) -> tuple[int, ...]:
        """Steps of the frames of the video of a scene. Raises InputError for a capture, whose files define them."""
        scene, steps = self.scene(name), self.dataset.steps or self.scene(name).steps
        if scene.captured:
            raise InputError(f"scenes.{name}", NO_TRUTH)
        if scene.frames is None and scene.images.stride is not None:
            return tuple(range(0, steps + 1, scene.images.stride))
        return scene.frames or self.dataset.frame_steps(steps)


def _pair_arguments(pair: PairConfig, bodies: Sequence[str]) -> dict[str, Any]:
    """Plain arguments of `neuma_lib.sim.bodies.Pair`, with the indices of the bodies in ascending order."""
    first, second = sorted(bodies.index(name) for name in pair.bodies)
    friction = {} if pair.friction is None else {"friction": pair.friction}
    return {"first": first, "second": second, **friction}
