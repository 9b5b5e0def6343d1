"""The files of a scene's viewer by the project's settings.

They lie below two folders: the one of the results that the scene is in, and the one of the data that the settings pair
with it.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from neuma_lib.config import cases, places
from neuma_lib.config.settings import Config
from neuma_lib.errors import InputError
from neuma_lib.io.files import existing
from neuma_lib.methods.base import ModelSource
from neuma_lib.methods.prior import prior_source
from neuma_lib.project import settings_around
from neuma_lib.viewer.files import RunFiles, SceneFiles


def law_source(settings: Config, scene: str, method: str) -> ModelSource | None:
    """What a method's law is loaded from. None: its motion follows from no law."""
    found = cases.case(settings, scene, method)
    return found.source() if found.method.has_law else None


def scene_files(settings: Config, scene: str, methods: Sequence[str]) -> SceneFiles:
    """Names of all files of a scene and some of its methods, whether they exist or not.

    Args:
        scene: with the seeds of its chain.
    """
    base, _ = settings.chain(scene)
    results, data = places.results_root(settings), settings.data_root.rstrip("/")
    section, chosen = settings.simulation.plain(), settings.scene(scene)
    runs = tuple(
        RunFiles(
            method,
            cases.title(settings, method),
            f"{results}/{scene}/{method}/rollout.h5",
            law_source(settings, scene, method),
            cases.gaussian_motion(settings, scene, method),
        )
        for method in methods
    )
    names = ("particles.h5", "binding.h5", "gaussians.ply", "velocity.json")
    constants = {name: section[name] for name in ("boundary", "walls")} | settings.scene_world(scene)
    return SceneFiles(
        name=scene,
        simulation={"dt": chosen.dt, **constants},
        density=chosen.plain()["density"],
        **{name.partition(".")[0]: places.home(settings, scene, name) for name in names},
        truth=f"{data}/{base}/particles.h5" if chosen.has_truth else None,
        transforms=None if chosen.splat else f"{data}/{base}/dynamic/transforms.json",
        runs=runs,
        roots=(results, data),
    )


def found_scene(place: str | Path, configfiles: Sequence[str | Path] = ()) -> tuple[Config, SceneFiles]:
    """A scene's folder that somebody names, with all methods that have a motion in it.

    The settings say where the data are relative to the results, so that a folder of another clone has its own.

    Args:
        place: folder of a scene, for example results/BouncyBall.
        configfiles: settings laid over those of the project that the folder lies in.

    Raises:
        InputError: no such folder, no settings, a scene that these do not know, a body that is not complete.
    """
    place = Path(place).absolute()
    if not place.is_dir():
        raise InputError(f"{place} is no folder: name that of a scene, for example results/BouncyBall")
    settings, _ = settings_around(place, configfiles)
    base, results = place.name.partition("+")[0], place.parent
    if base not in settings.scenes:
        known = ", ".join(sorted(settings.scenes))
        raise InputError(
            f"{place}: the settings know no scene '{base}' (they have {known}); give the --configfile that it was made "
            "with"
        )
    data = os.path.abspath(results / os.path.relpath(settings.data_root, settings.results_root))
    settings = settings.model_copy(update={"results_root": str(results), "data_root": data})
    files = scene_files(settings, place.name, found_methods(settings, place))
    for file in (files.particles, files.binding, files.gaussians):
        existing(file, f"make it with `snakemake --cores 2 results/{place.name}/<method>/rollout.h5`")
    optional = {name: getattr(files, name) for name in ("velocity", "truth", "transforms")}
    missing = [name for name, file in optional.items() if not file or not Path(file).is_file()]
    return settings, replace(files, **dict.fromkeys(missing))


def found_methods(settings: Config, place: Path) -> list[str]:
    """Methods with a motion in a scene's folder, in the order of the settings; what these do not know is left out."""
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


def found_laws(settings: Config, scene: str | None = None) -> dict[str, ModelSource]:
    """All laws in the folder of results whose files are complete, by a name for a list, in order.

    Those that methods trained or identified in scenes, ``scene: title of the method``, and priors, ``prior: name``,
    with the time step of a scene that has them: of the given one, if it does, or else the first.
    """
    results = Path(places.results_root(settings))
    found: dict[str, ModelSource] = {}
    for folder in sorted(results.glob("*/")):
        if folder.name.partition("+")[0] not in settings.scenes:
            continue
        made = {
            file.parent.name
            for name in ("adaptor.safetensors", "rollout.h5")
            for file in folder.glob(f"*/{name}")
        }
        for method in sorted(name for name in made if _known(settings, name)):
            try:
                law = law_source(settings, folder.name, method)
            except InputError:
                continue  # a variant that these settings do not know
            learned = law and law.paths and cases.case(settings, folder.name, method).learns_there
            if learned and all(Path(file).is_file() for file in law.paths):
                found[f"{folder.name}: {cases.title(settings, method)}"] = law
    own = [settings.scene(scene)] if scene else []
    steps = {each.prior: each.dt for each in (*reversed(settings.scenes.values()), *own)}
    for file in sorted((results / "priors").glob("*.safetensors")):
        name = file.stem
        if name.partition("+")[0] in settings.priors.laws:
            dt = steps.get(name.partition("+")[0], min(each.dt for each in settings.scenes.values()))
            found[f"prior: {name}"] = prior_source(str(file), dt)
    return found
