"""Methods on scenes: options, runs and paths of a preset or variant. No file is read or has to exist."""

import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from neuma_lib.config.base import Section
from neuma_lib.config.validation import hint, validate
from neuma_lib.config.variants import SEEDS, replicate_folder, split_variant
from neuma_lib.errors import InputError
from neuma_lib.io.yaml_files import parse_yaml
from neuma_lib.methods.base import Case, Method, ModelSource
from neuma_lib.methods.registry import methods
from neuma_lib.project import paths
from neuma_lib.project.methods import PresetConfig
from neuma_lib.project.paths import IDENTIFIED
from neuma_lib.project.settings import NO_TRUTH, Config

LAW_FROM = "law_from"
"""Key of a variant: the scene whose model moves all bodies, instead of the model of each scene."""


@dataclass(frozen=True)
class ProjectCase(Case):
    """A case whose paths and options come from the settings of a project."""

    settings: Config
    scene: str
    moved: str
    name: str
    folder: str
    options: Any
    evaluate_on: str
    method: Method
    together: tuple[Case, str] | None = None

    def on_moved(self) -> "ProjectCase":
        return replace(self, scene=self.moved)

    @property
    def prior(self) -> str:
        named = getattr(self.options, "prior", None)
        return self.settings.scene(self.scene).prior if named is None else named

    @property
    def prior_law(self) -> dict[str, Any] | None:
        return published_law(self.settings, self.prior)

    @property
    def scene_law(self) -> dict[str, Any]:
        law = self.settings.scene(self.scene).law
        if law is None:
            raise InputError(f"{self.scene}/{self.name}", NO_TRUTH)
        return law.plain()

    def section(self, name: str) -> dict[str, Any]:
        return getattr(self.settings, name).plain()

    def result(self, file: str) -> str:
        return paths.result_path(self.settings, self.scene, file)

    def data(self, file: str) -> str:
        base, _ = self.settings.replicate(self.scene)
        return f"{self.settings.data_root.rstrip('/')}/{base}/{file}"

    def rollout(self) -> str:
        return f"{paths.results_root(self.settings)}/{self.moved}/{self.folder}/rollout.h5"

    def product(self) -> str:
        run = f"{replicate_folder(*self.settings.replicate(self.scene), self.seeds())}/{self.name}"
        return f"{paths.results_root(self.settings)}/{run}/{self.method.product}"

    def prior_file(self) -> str:
        return paths.prior_file(self.settings, self.scene, self.prior)

    def identified(self) -> str:
        views = self.options.views
        if views in (self.settings.training.views, self.settings.identify.views):
            return "identified.json"
        return f"identified+views={','.join(map(str, views))}.json"

    @property
    def bodies(self) -> dict[str, Case]:
        base, _ = self.settings.replicate(self.scene)
        scenes = self.settings.body_scenes(self.scene)
        return {
            name: replace(self, scene=scene)
            for name, scene in zip(self.settings.scenes[base].bodies, scenes, strict=False)
        }

    def each_video(self, choose: Callable[[Case], str]) -> str | list[str]:
        scenes = self.settings.video_scenes(self.scene)
        own, *others = (self.settings.obstacles(scene) for scene in scenes)
        if any(other != own for other in others):
            problem = f"colliders or clamps differ, and {self.name} is trained in videos with the same"
            remedy = "Use the identified constants, or train in the videos of scenes with the same obstacles"
            raise InputError(f"scenes.{self.scene}.videos", problem, remedy)
        paths = [choose(replace(self, scene=scene)) for scene in scenes]
        return paths if len(paths) > 1 else paths[0]

    def seeds(self) -> tuple[str, ...]:
        """Seeds of a replicate that change the results."""
        return tuple(name for name in SEEDS if name in self.method.seeds(self))

    def density(self, scene: str) -> float | dict[str, Any]:
        """Density that the method assumes for the body of a scene [kg/m^3]."""
        assumed = self.options.assumed_density
        return self.settings.scene(scene).plain()["density"] if assumed is None else assumed

    @property
    def densities(self) -> list[float | dict[str, Any]]:
        """The same for all bodies of a fit."""
        videos = self.settings.video_scenes(self.scene)
        return [self.density(scene) for video in videos for scene in self.settings.body_scenes(video)]

    @property
    def learned_from_moved_scene(self) -> bool:
        """Whether the model is obtained from the moved scene itself."""
        return self.scene == self.moved and self.method.learns_from_video(self)

    def source(self) -> ModelSource:
        """What the model is loaded from."""
        dt = self.settings.scene(self.scene).dt
        module = type(self.method).__module__
        return ModelSource(module, self.method.model_options(self), self.method.model_inputs(self), dt)


def published_law(settings: Config, prior: str) -> dict[str, Any] | None:
    """The analytic law that a prior is trained on. None if the prior is a file of the user."""
    law = settings.priors.laws.get(prior)
    return law.plain() if law else None


def preset(settings: Config, method: str) -> tuple[PresetConfig, dict[str, Any]]:
    """Preset of a preset or variant, and the options in its name.

    Args:
        method: name of a folder of results, for example ``neuma+rank=4+law_from=ClayCat``. Values are YAML scalars, and
            commas make lists.

    Raises:
        InputError: unknown preset or option, an option that is given twice, a piece without '='.
    """
    base = method.partition("+")[0]
    options = kind_of(settings, base).Options.model_fields if base in settings.methods else {}
    base, texts = split_variant(method, settings.methods, [LAW_FROM, *options], "method")
    given: dict[str, Any] = {}
    for key, value in texts.items():
        is_list = key in options and typing.get_origin(options[key].annotation) is tuple
        values = [parse_yaml(text, method) for text in (value.split(",") if is_list else [value])]
        given[key] = values if is_list else values[0]
    return settings.methods[base], given


def kind_of(settings: Config, method: str) -> Method:
    """The method of a preset or variant."""
    name = method.partition("+")[0]
    chosen = settings.methods[settings.methods[name].same_fit_as or name]
    return methods(settings.extensions)[chosen.kind]


def of_kind(settings: Config, name: str) -> list[str]:
    """Presets of a method with their own fit, in the order of the settings."""
    own = (key for key, chosen in settings.methods.items() if chosen.same_fit_as is None)
    return [key for key in own if settings.methods[key].kind == name]


def title(settings: Config, method: str) -> str:
    """Name of a preset or variant for tables, for example "NeuMA, rank 4"."""
    chosen, given = preset(settings, method)
    texts = {key: ",".join(map(str, v)) if isinstance(v, list) else v for key, v in given.items()}
    return ", ".join([chosen.title, *(f"{key} {text}" for key, text in texts.items())])


def fit_name(settings: Config, method: str) -> str:
    """The preset or variant whose fit gives a method's model, in the scene that the model is from."""
    base, *pieces = method.split("+")
    others = [piece for piece in pieces if not piece.startswith(f"{LAW_FROM}=")]
    return "+".join([settings.methods[base].same_fit_as or base, *others])


def source_scene(settings: Config, scene: str, method: str) -> str:
    """Folder of the scene that a method's model is obtained from, in the replicate of a scene."""
    source = law_from(settings, method)
    return scene if source is None else replicate_folder(source, settings.replicate(scene)[1])


def law_from(settings: Config, method: str) -> str | None:
    """The scene that a variant's model is obtained from. None: the scene whose motion is predicted.

    Raises:
        InputError: unknown names, or a model that moves only the body that it is fitted to.
    """
    source = preset(settings, method)[1].get(LAW_FROM)
    if source is not None and source not in settings.scenes:
        raise InputError(method, f"no scene '{source}'{hint(source, settings.scenes)}")
    if source is not None and not kind_of(settings, method).moves_other_bodies:
        problem = "its model moves only the body that it is fitted to"
        raise InputError(method, problem, f"Leave out {LAW_FROM}")
    return source


def case(settings: Config, scene: str, method: str, fit: bool = False) -> ProjectCase:
    """A preset or variant on a scene.

    Args:
        scene: folder of the scene, with the seeds of its replicate.
        fit: admit a scene of several bodies if the method is fitted to all of them together.

    Raises:
        InputError: unknown names, options that do not fit.
    """
    chosen, _ = preset(settings, method)
    if settings.scene(scene).bodies and not (fit and kind_of(settings, method).fits_together):
        problem = "it has several bodies, and a model is of one"
        raise InputError(
            f"{scene}/{method}", problem, f"Take the scenes {', '.join(settings.body_scenes(scene))}"
        )
    kind, source = kind_of(settings, method), source_scene(settings, scene, method)
    name, options = fit_name(settings, method), _options(settings, source, method)
    check_prior(settings, method, options)
    return ProjectCase(settings, source, scene, name, method, options, chosen.evaluate_on, kind)


def check_prior(settings: Config, where: str, options: Section) -> None:
    """Raise an InputError if the option ``prior`` of a method is neither in priors.laws nor the identified law."""
    prior, known = getattr(options, "prior", None), [*settings.priors.laws, IDENTIFIED]
    if prior is not None and prior not in known:
        problem = f"no prior '{prior}' in priors.laws{hint(prior, known)}"
        raise InputError(where, problem, "A law in a file is the prior of a scene")


def _options(settings: Config, scene: str, method: str) -> Section:
    """Effective options: sections of the settings, changed by the scene, the preset and the variant, in this order.

    The seed of the scene's replicate is added to the option ``seed``.
    """
    fitted = fit_name(settings, method)
    chosen, given = preset(settings, fitted)
    kind = kind_of(settings, fitted)
    base, seeds = settings.replicate(scene)
    known = kind.Options.model_fields
    own = settings.scene(base).training
    values = section_values(settings, kind) | {key: value for key, value in own.items() if key in known}
    validate(kind.Options, values, f"scenes.{base}.training")
    values |= chosen.options
    validate(kind.Options, values, f"methods.{fitted.partition('+')[0]}.options")
    options = validate(kind.Options, values | given, fitted)
    if "seed" in known:
        options = options.model_copy(update={"seed": options.seed + seeds["adaptor"]})
    return options


def section_values(settings: Config, kind: Method) -> dict[str, Any]:
    """Options of a method that the sections of the settings define."""
    values: dict[str, Any] = {}
    for name in kind.sections:
        values |= getattr(settings, name).plain()
    return {key: value for key, value in values.items() if key in kind.Options.model_fields}


# ---- runs


def body_cases(settings: Config, column: str, method: str) -> list[ProjectCase]:
    """A method on the scene of each body of a scene or experiment, in its replicate.

    Raises:
        InputError: several bodies, and a model without a material law.
    """
    cases = [case(settings, scene, method) for scene in settings.body_scenes(column)]
    pile, names = settings.touching_bodies(column)
    base, seeds = settings.replicate(column)
    own = all(each.scene == each.moved for each in cases)  # not the law of another scene
    if pile and own and not (base in settings.scenes and settings.scenes[base].part_of):
        whole = replicate_folder(pile, seeds)
        cases = [
            replace(each, together=(replace(each, scene=whole, moved=whole), name))
            for each, name in zip(cases, names, strict=True)
        ]
    if len(cases) > 1 and not cases[0].method.has_law:
        problem = "it has no material law, so that it cannot move several bodies together"
        raise InputError(f"{column}/{method}", problem)
    return cases


def run_folder(settings: Config, column: str, method: str) -> str:
    """Folder of a method's run, below the one of the results or of the experiments.

    Args:
        column: folder of a scene or experiment, with the seeds of its replicate. Seeds that change nothing in the run
            are left out, so that it is computed once.
    """
    base, seeds = settings.replicate(column)
    used = {name for each in body_cases(settings, column, method) for name in each.seeds()}
    return f"{replicate_folder(base, seeds, [name for name in SEEDS if name in used])}/{method}"


def runs(settings: Config, table: str, method: str, column: str) -> list[str]:
    """Folders of the runs behind a cell of a table, in the order of its replicates, each once."""
    chosen = settings.tables[table]
    replicates = (replicate_folder(column, dict.fromkeys(chosen.vary, k)) for k in range(chosen.seeds))
    return list(dict.fromkeys(run_folder(settings, each, method) for each in replicates))


def gaussian_motion(settings: Config, scene: str, method: str) -> str:
    """Motion of the Gaussians, affine for splats, many of whose Gaussians are outside the body."""
    return "affine" if settings.scene(scene).splat else case(settings, scene, method).options.gaussian_motion


def moving_methods(settings: Config, scene: str, requested: Sequence[str]) -> list[str]:
    """Requested methods that predict the motion of a scene.

    A splat has no video, so methods that learn use the models of the scenes ``figures.i23d``.

    Raises:
        InputError: a splat, and a method whose model cannot come from another scene.
    """
    if not settings.scene(scene).splat:
        return list(requested)
    moving = []
    for method in requested:
        if not kind_of(settings, method).moves_other_bodies:
            problem = "a splat has no video to fit this method to"
            raise InputError(f"{scene}/{method}", problem, "Leave the method out")
        elsewhere = case(settings, scene, method).learned_from_moved_scene
        sources = settings.figures.i23d if elsewhere else (None,)
        moving += [f"{method}+{LAW_FROM}={source}" if source else method for source in sources]
    return list(dict.fromkeys(moving))


def motion_clock(settings: Config, scene: str, method: str) -> tuple[float, tuple[int, ...]]:
    """Time step of the prediction of a splat [s], and the steps of its frames.

    A law is valid for the time step of its training, so this is the step of the scene of the model.
    """
    dt, law_dt = settings.scene(scene).dt, settings.scene(source_scene(settings, scene, method)).dt
    return law_dt, tuple(round(step * dt / law_dt) for step in settings.frame_steps(scene))


def law_origin(settings: Config, scene: str, method: str) -> dict[str, Any]:
    """Origin of a method's law according to the settings, with the keys of `neuma_lib.io.exported`."""
    of_law = case(settings, scene, method)
    chosen = settings.scene(of_law.scene)
    return {
        "dt": chosen.dt,
        **settings.scene_world(of_law.scene),
        "density": of_law.density(of_law.scene),
        "scale": chosen.captured.scale if chosen.captured else chosen.images.scale,
        "scene": of_law.scene,
        "method": method,
        "prior": of_law.prior if "prior" in of_law.method.model_inputs(of_law) else None,
    }
