"""Checks of settings across sections: names that exist, options that fit their method, independent seeds."""

import os
import re
from collections.abc import Iterator
from functools import partial, reduce
from pathlib import Path

from neuma_lib.config.figures import FiguresConfig
from neuma_lib.config.identify import FRICTION_NEEDS
from neuma_lib.config.validation import hint, joined, validate
from neuma_lib.config.variants import name_problem
from neuma_lib.errors import InputError
from neuma_lib.io.files import one_line
from neuma_lib.methods.registry import methods
from neuma_lib.project.cases import check_prior, law_from, section_values
from neuma_lib.project.paths import IDENTIFIED
from neuma_lib.project.settings import Config

SOURCES = ("config", "docs", "neuma_lib", "profiles", "workflow")  # folders of a project
SYSTEM = ("bin", "boot", "dev", "etc", "lib", "lib64", "proc", "sbin", "sys", "usr")
"""Folders at the root of the file system that are no place for results."""
SAMPLED_IN_TRUTH = ("particles", "tracers", "second tracers")
"""What the seeds dataset.seed, dataset.seed + 1 and dataset.seed + 2 sample, see `neuma_lib.data.ground_truth`."""
SHARED_BY_VIDEOS = ("law", "prior", "dt", "friction")  # keys that the scenes of several videos have in common


def check_consistency(settings: Config, root: str | Path = ".") -> None:
    """Raise an InputError that lists all problems, or all of the methods where there is no other one."""
    for check in (partial(_section_errors, root=root), _method_errors):
        errors: dict[str, InputError] = {}
        for error in check(settings):
            errors.setdefault(error.where, error)  # one for each key
        if errors:
            raise joined(list(errors.values()))


def _section_errors(settings: Config, root: str | Path) -> Iterator[InputError]:
    yield from _name_errors(settings)
    yield from _folder_errors(settings, root)
    if settings.identify.contact_friction == "fitted" and settings.simulation.contact != "particles":
        yield InputError("identify.contact_friction", *FRICTION_NEEDS)
    for name in settings.scenes:
        yield from _scene_errors(settings, name)
    for name in settings.methods:
        yield from _preset_errors(settings, name)
    for where, kind, name in _references(settings):
        known = settings.scenes if kind == "scene" else settings.experiments
        if name not in known:
            yield InputError(where, f"no {kind} '{name}'{hint(name, known)}")
    for name, experiment in settings.experiments.items():
        for k, body in enumerate(experiment.bodies):
            if body.scene in settings.scenes and settings.scenes[body.scene].bodies:
                problem = f"'{body.scene}' has several bodies, and an experiment needs the law of one"
                yield InputError(f"experiments.{name}.bodies.{k}.scene", problem, "Name another scene")
        if all(body.scene in settings.scenes for body in experiment.bodies):
            yield from _raised_by(settings.experiment_truth, name)
    yield from _sampling_errors(settings)
    for name, table in settings.tables.items():
        drawn = [scene for scene in table.scenes if scene.startswith(settings.random.prefix)]
        if drawn and settings.random.is_development:
            problem = f"{drawn[0]} is of a seed for development (random.development_seeds)"
            yield InputError(f"tables.{name}.scenes", problem, "Choose another random.seed")


def _name_errors(settings: Config) -> Iterator[InputError]:
    """Names are folders, in which + begins a variant, and differ from each other."""
    named = {kind: getattr(settings, kind) for kind in ("scenes", "experiments", "methods", "tables")}
    named |= {"priors.laws": settings.priors.laws, "captures.released": settings.captures.released}
    named |= {f"random.{kind}": getattr(settings.random, kind) for kind in ("families", "outside")}
    for kind, names in named.items():
        for name in names:
            if problem := name_problem(name):
                yield InputError(f"{kind}.{one_line(name)}", problem, "Choose another name")
    if IDENTIFIED in settings.priors.laws:
        where = f"priors.laws.{IDENTIFIED}"
        problem = "the name is reserved for the law identified in the video"
        yield InputError(where, problem, "Choose another name")
    for name in settings.scenes.keys() & settings.experiments.keys():
        yield InputError(f"experiments.{name}", "a scene has this name")


def _folder_errors(settings: Config, root: str | Path) -> Iterator[InputError]:
    """Folders that rules write to hold nothing else."""
    project, home = Path(root).resolve(), Path(os.path.expanduser("~"))
    used: dict[Path, str] = {}
    for key in ("data_root", "results_root", "kernel_cache", "captures.root"):
        folder = reduce(getattr, key.split("."), settings)
        if not re.fullmatch(r"[^\s~{}*?\[\]\\][^{}*?\[\]\\]{0,199}", folder) or not folder.isprintable():
            yield InputError(
                key, f"'{one_line(folder)}' does not name a folder", "Give one, such as results/mine"
            )
            continue
        path = (project / folder).resolve()
        first, *below = path.parts[1:3] or [""]
        if not below or path in (home, *home.parents, project, *project.parents):
            problem = f"{path} holds more than this project's files"
        elif path.is_relative_to(project) and path.relative_to(project).parts[0] in SOURCES:
            problem = f"{path} holds the project's own files"
        elif first in SYSTEM and (first, *below) != ("dev", "shm"):
            problem = f"{path} belongs to the system"
        elif path in used:
            problem = f"{path} is {used[path]}"
        else:
            used[path] = key
            continue
        yield InputError(key, problem, "Give another folder, such as results/mine")


def _scene_errors(settings: Config, name: str) -> Iterator[InputError]:
    scene = settings.scenes[name]
    if not settings.is_own_capture(name):  # otherwise it stops only what needs the capture
        yield from prior_errors(settings, name)
    changed = {**settings.training.plain(), **scene.training}
    yield from _raised_by(validate, type(settings.training), changed, f"scenes.{name}.training")
    yield from _raised_by(settings.scene_truth, name)
    yield from _video_errors(settings, name)


def prior_errors(settings: Config, name: str) -> Iterator[InputError]:
    """The prior of a scene is one of the settings, or a file."""
    prior, laws = settings.scenes[name].prior, settings.priors.laws
    if "/" not in prior and "." not in prior and prior not in laws:
        yield InputError(f"scenes.{name}.prior", f"no prior '{prior}' in priors.laws{hint(prior, laws)}")


def _video_errors(settings: Config, name: str) -> Iterator[InputError]:
    """The videos of a scene are of other scenes, of the same material and time step."""
    scene, where = settings.scenes[name], f"scenes.{name}.videos"
    for video in scene.videos:
        if video not in settings.scenes:
            yield InputError(where, f"no scene '{video}'{hint(video, settings.scenes)}")
            continue
        other, supplied = settings.scenes[video], settings.scenes[video].images.dynamic
        if video == name or scene.videos.count(video) > 1:
            yield InputError(where, f"'{video}' is listed twice", "The scene's own video always counts")
        elif supplied is not None and supplied == scene.images.dynamic:
            yield InputError(where, f"'{video}' has the same video, {supplied}", "Give it images.dynamic")
        if other.bodies:
            yield InputError(where, f"'{video}' has several bodies", "Name scenes of one body")
        if other.videos:
            yield InputError(where, f"'{video}' lists videos itself", "List all in one of the two scenes")
        differing = [key for key in SHARED_BY_VIDEOS if getattr(other, key) != getattr(scene, key)]
        if differing:
            problem = f"'{video}' differs in {', '.join(differing)}, but one law is identified for all videos"
            yield InputError(where, problem, "Give both the same")


def _preset_errors(settings: Config, name: str) -> Iterator[InputError]:
    """The kind of a preset exists, and its options are those of the kind."""
    preset, where = settings.methods[name], f"methods.{name}"
    if preset.same_fit_as is not None:
        own = [known for known, entry in settings.methods.items() if entry.same_fit_as is None]
        if preset.same_fit_as not in own:
            problem = f"no preset '{preset.same_fit_as}' with its own fit{hint(preset.same_fit_as, own)}"
            yield InputError(f"{where}.same_fit_as", problem)
            return
        kind = settings.methods[preset.same_fit_as].kind
        if preset.kind not in (None, kind):
            problem = f"{preset.kind} differs from the kind of '{preset.same_fit_as}', {kind}"
            yield InputError(f"{where}.kind", problem, "Leave it out")
        return
    known_methods = methods(settings.extensions)
    if preset.kind not in known_methods:
        yield InputError(f"{where}.kind", f"no method '{preset.kind}'{hint(preset.kind, known_methods)}")
        return
    kind = known_methods[preset.kind]
    try:
        options = validate(kind.Options, section_values(settings, kind) | preset.options, f"{where}.options")
    except InputError as error:
        yield error
        return
    yield from _raised_by(check_prior, settings, f"{where}.options.prior", options)


def _references(settings: Config) -> Iterator[tuple[str, str, str]]:
    """Where a scene or an experiment is named: path of the key, "scene" or "experiment", name."""
    for name, experiment in settings.experiments.items():
        for k, body in enumerate(experiment.bodies):
            yield f"experiments.{name}.bodies.{k}.scene", "scene", body.scene
    # The default figures show scenes of the benchmark, which a project without scenes does not have.
    for key, kind in FiguresConfig.SHOWN.items():
        value = getattr(settings.figures, key) if kind == "experiment" or settings.scenes else ()
        for name in filter(None, [value] if isinstance(value, str) else value):
            yield f"figures.{key}", kind, name
    if settings.scenes:
        yield "demo.scene", "scene", settings.demo.scene
    for name, table in settings.tables.items():
        for kind in ("scene", "experiment"):
            for column in getattr(table, f"{kind}s"):
                yield f"tables.{name}.{kind}s", kind, column


def _sampling_errors(settings: Config) -> Iterator[InputError]:
    """Truth and prediction are sampled with equal counts and independent seeds, as the sampling floor assumes."""
    dataset, tracers = settings.dataset, settings.evaluation.tracers
    if tracers != dataset.tracers:
        yield InputError(
            "evaluation.tracers",
            f"{tracers} in the prediction differ from dataset.tracers = {dataset.tracers} in the truth",
            "Set both to the same number",
        )
    replicates = max((table.seeds for table in settings.tables.values()), default=1)
    used = range(settings.seed, settings.seed + replicates)
    shared = [(k, sampled) for k, sampled in enumerate(SAMPLED_IN_TRUTH, dataset.seed) if k in used]
    for k, sampled in shared[:1]:
        yield InputError(
            "dataset.seed",
            f"{dataset.seed} samples the {sampled} of the truth with the seed {k}, which a replicate of the "
            f"reconstruction has too (seed = {settings.seed})",
            "Choose a larger dataset.seed",
        )


def _method_errors(settings: Config) -> Iterator[InputError]:
    """Presets and variants that tables, figures and the demo name."""
    named = {"figures.beside": settings.figures.beside}
    named["random.methods"] = settings.random.methods if settings.random.count else ()
    named["demo.methods"] = settings.demo.methods if "demo" in settings.model_fields_set else ()
    for name, table in settings.tables.items():
        named[f"tables.{name}"] = (*table.methods, *table.titles)
    for where, names in named.items():
        for method in names:
            for error in _raised_by(law_from, settings, method):
                yield InputError(where, str(error))


def _raised_by(check, *values) -> list[InputError]:
    """The InputError that a call raises, if any."""
    try:
        check(*values)
    except InputError as error:
        return [error]
    return []
