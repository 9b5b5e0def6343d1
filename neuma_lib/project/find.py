"""Locate the files of a scene by the project's settings.

They are in two folders: that of the results with the scene, and the corresponding folder of the data.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from neuma_lib.errors import InputError
from neuma_lib.io.files import existing
from neuma_lib.methods.base import ModelSource
from neuma_lib.methods.prior import prior_source
from neuma_lib.project import cases, paths
from neuma_lib.project.files import RunFiles, SceneFiles
from neuma_lib.project.project import Project
from neuma_lib.project.settings import Config


def law_source(settings: Config, scene: str, method: str) -> ModelSource | None:
    """The source of a method's law; None if its motion follows from no law, or from those of several bodies."""
    if settings.scene(scene).bodies:
        return None
    case = cases.case(settings, scene, method)
    return case.source() if case.method.has_law else None


def scene_files(settings: Config, scene: str, methods: Sequence[str]) -> SceneFiles:
    """Paths of all files of a scene and some of its methods, which need not exist.

    Args:
        scene: with the seeds of its replicate.
    """
    base, _ = settings.replicate(scene)
    results, data = paths.results_root(settings), settings.data_root.rstrip("/")
    section, chosen = settings.simulation.plain(), settings.scene(scene)
    runs = tuple(
        RunFiles(
            method,
            cases.title(settings, method),
            f"{results}/{scene}/{method}/rollout.h5",
            law_source(settings, scene, method),
            cases.gaussian_motion(settings, settings.body_scenes(scene)[0], method),
        )
        for method in methods
    )
    names = ("particles.h5", "binding.h5", "gaussians.ply", "velocity.json")
    constants = {name: section[name] for name in ("boundary", "contact")} | settings.scene_world(scene)
    constants |= settings.obstacles(scene)
    return SceneFiles(
        name=scene,
        simulation={"dt": chosen.dt, **constants},
        density=chosen.plain()["density"],
        **{name.partition(".")[0]: paths.result_path(settings, scene, name) for name in names},
        truth=f"{data}/{base}/truth.h5"
        if chosen.has_truth or chosen.bodies and not chosen.captured
        else None,
        transforms=None if chosen.splat else f"{data}/{base}/dynamic/transforms.json",
        runs=runs,
        roots=(results, data),
    )


def find_scene(place: str | Path, configfiles: Sequence[str | Path] = ()) -> tuple[Config, SceneFiles]:
    """Settings and files of a scene's folder, with all methods that have a motion there.

    The settings define the position of the data relative to the results, so the folder may be in another clone.

    Args:
        place: folder of a scene, for example results/BouncyBall.
        configfiles: settings that override those of the folder's project.

    Raises:
        InputError: no such folder, no settings, an unknown scene, an incomplete body.
    """
    place = Path(place).absolute()
    if not place.is_dir():
        raise InputError(place, "is not a folder", "Give that of a scene, for example results/BouncyBall")
    settings, _ = Project.find(place, configfiles)
    base, results = place.name.partition("+")[0], place.parent
    if base not in settings.scenes:
        problem = f"the settings have no scene '{base}', only {', '.join(sorted(settings.scenes))}"
        raise InputError(place, problem, "Give the --configfile of the folder")
    data = os.path.abspath(results / os.path.relpath(settings.data_root, settings.results_root))
    settings = settings.model_copy(update={"results_root": str(results), "data_root": data})
    files = scene_files(settings, place.name, _find_methods(settings, place))
    for file in (files.particles, files.binding, files.gaussians):
        existing(file, f"Generate it with `snakemake --cores 2 results/{place.name}/<method>/rollout.h5`")
    optional = {name: getattr(files, name) for name in ("velocity", "truth", "transforms")}
    missing = [name for name, file in optional.items() if not file or not Path(file).is_file()]
    return settings, replace(files, **dict.fromkeys(missing))


def _find_methods(settings: Config, place: Path) -> list[str]:
    """Methods with a motion in a scene's folder, in the order of the settings, without unknown ones."""
    order = list(settings.methods)
    names = (file.parent.name for file in place.glob("*/rollout.h5"))
    known = [name for name in names if _known(settings, name)]
    return sorted(known, key=lambda name: (order.index(name.partition("+")[0]), name))


def _known(settings: Config, method: str) -> bool:
    try:
        cases.title(settings, method)
    except InputError:
        return False
    return True


def find_laws(settings: Config, scene: str | None = None) -> dict[str, ModelSource]:
    """All laws with complete files in the folder of results, by display name, in order.

    Includes laws trained or identified in scenes, ``scene: title of the method``, and priors, ``prior: name``, with the
    time step of a scene that uses them, preferably the given one.
    """
    results = Path(paths.results_root(settings))
    laws: dict[str, ModelSource] = {}
    for folder in sorted(results.glob("*/")):
        if folder.name.partition("+")[0] not in settings.scenes:
            continue
        methods = {
            file.parent.name
            for name in ("adaptor.safetensors", "rollout.h5")
            for file in folder.glob(f"*/{name}")
        }
        for method in sorted(name for name in methods if _known(settings, name)):
            try:
                law = law_source(settings, folder.name, method)
            except InputError:
                continue  # unknown variant
            learned = law and law.paths and cases.case(settings, folder.name, method).learned_from_moved_scene
            if learned and all(Path(file).is_file() for file in law.paths):
                laws[f"{folder.name}: {cases.title(settings, method)}"] = law
    own = [settings.scene(scene)] if scene else []
    steps = {each.prior: each.dt for each in (*reversed(settings.scenes.values()), *own)}
    for file in sorted((results / "priors").glob("*.safetensors")):
        name = file.stem
        if name.partition("+")[0] in settings.priors.laws:
            dt = steps.get(name.partition("+")[0], min(each.dt for each in settings.scenes.values()))
            laws[f"prior: {name}"] = prior_source(str(file), dt)
    return laws
