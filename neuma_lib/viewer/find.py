"""The files of a scene's viewer by the project's settings, and laws that may be swapped in.

They lie below two folders: the one of the results that the scene is in, and the one of the data that the settings pair
with it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

from neuma_lib.config.methods import IDENTIFIED
from neuma_lib.config.settings import Config, load, merged, read_yaml
from neuma_lib.config.variants import DRAWN, folder
from neuma_lib.errors import InputError
from neuma_lib.io.files import existing
from neuma_lib.viewer.files import LawFiles, RunFiles, SceneFiles

SETTINGS = Path("config/config.yaml")
"""Settings of a project, below its folder."""


def law_files(settings: Config, scene: str, method: str, home: Callable[[str, str], str]) -> LawFiles | None:
    """The files of a method's law; None for springs, which have none.

    Args:
        scene: with the seeds of its chain.
        home: gives the file of a chain, for example ``home(scene, "identified.json")``.
    """
    if settings.is_springs(method):
        return None
    results = settings.results_root.rstrip("/")
    dt, source = settings.scene(scene).dt, settings.law_scene(scene, method)
    run = f"{results}/{settings.run_folder(source, settings.method_training(method))}"
    if spec := settings.true_law(scene, method):
        return LawFiles(spec=spec, dt=dt)
    if settings.is_pac_nerf(method):
        return LawFiles(identified=f"{run}/constants.json", dt=dt)
    if settings.is_identified(method):
        views = settings.identified_views(source, method)
        name = f"identified+views={','.join(map(str, views))}.json" if views else "identified.json"
        return LawFiles(identified=home(source, name), dt=dt)
    adaptor = f"{run}/adaptor.safetensors" if settings.method_material(scene, method).train else None
    prior = None if settings.is_structured(method) else prior_file(settings, source, method, home)
    return LawFiles(prior=prior, adaptor=adaptor, dt=dt)


def prior_file(settings: Config, scene: str, method: str, home: Callable[[str, str], str]) -> str:
    """The file of the prior that a method starts from."""
    name = settings.method_prior(scene, method)
    if name == IDENTIFIED:
        return home(scene, "priors/identified.safetensors")
    if name not in settings.priors.laws:
        return name
    seeds = settings.chain(scene)[1]
    return f"{settings.results_root.rstrip('/')}/priors/{folder(name, seeds, ['prior'])}.safetensors"


def scene_files(
    settings: Config,
    scene: str,
    methods: Sequence[str],
    home: Callable[[str, str], str],
    truth: bool = True,
) -> SceneFiles:
    """Names of all files of a scene and some of its methods, whether they exist or not.

    Args:
        home: as of `law_files`.
        truth: whether true motion and images are among them.
    """
    base, _ = settings.chain(scene)
    results, data = settings.results_root.rstrip("/"), settings.data_root.rstrip("/")
    section = settings.simulation.plain()
    chosen = settings.scene(scene)
    runs = tuple(
        RunFiles(
            method,
            settings.method_title(method),
            f"{results}/{scene}/{method}/rollout.h5",
            law_files(settings, scene, method, home),
            settings.method_material(scene, method).gaussian_motion,
        )
        for method in methods
    )
    return SceneFiles(
        name=scene,
        simulation={
            "dt": chosen.dt,
            **{name: section[name] for name in ("grid", "gravity", "boundary", "walls")},
        },
        density=chosen.plain()["density"],
        **{name: home(scene, f"{name}.h5") for name in ("particles", "binding")},
        gaussians=home(scene, "gaussians.ply"),
        velocity=home(scene, "velocity.json"),
        truth=f"{data}/{base}/particles.h5" if truth else None,
        transforms=f"{data}/{base}/dynamic/transforms.json" if truth else None,
        runs=runs,
        roots=(results, data),
    )


def found_scene(place: str | Path, configfiles: Sequence[str | Path] = ()) -> tuple[Config, SceneFiles]:
    """A scene's folder that somebody names, with all methods that have a motion in it.

    The settings say where the data are relative to the results, so that a folder of another clone has its own.

    Args:
        place: folder of a scene, for example results/BouncyBall.
        configfiles: settings, each laid over those before; none: `SETTINGS` of the project that the folder lies in.

    Raises:
        InputError: no such folder, no settings, a scene that these do not know, a body that is not complete.
    """
    place = Path(place).absolute()
    if not place.is_dir():
        raise InputError(f"{place} is no folder: name that of a scene, for example results/BouncyBall")
    settings = _settings_of(place, configfiles)
    base = place.name.partition("+")[0]
    if base not in settings.scenes:
        known = ", ".join(sorted(settings.scenes))
        raise InputError(
            f"{place}: the settings know no scene '{base}' (they have {known}); give the --configfile that it was made "
            "with"
        )
    root = place.parent
    data = Path(os.path.abspath(root / os.path.relpath(settings.data_root, settings.results_root)))
    settings = settings.model_copy(update={"results_root": str(root), "data_root": str(data)})

    def home(scene: str, file: str) -> str:
        """The one folder of a chain's that has the file; the scene's own where none has."""
        name, seeds = settings.chain(scene)
        subsets = [drawn for size in range(len(DRAWN) + 1) for drawn in combinations(DRAWN, size)]
        names = dict.fromkeys(folder(name, seeds, drawn) for drawn in subsets)
        # the longest name differs from the base scene in most: what the chain has of its own comes first
        found = [n for n in sorted(names, key=len, reverse=True) if (root / n / file).is_file()]
        return str(root / (found[0] if found else scene) / file)

    names = [folder.parent.name for folder in place.glob("*/rollout.h5")]
    order = list(settings.methods)
    methods = sorted(
        filter(lambda name: _known(settings, name), names),
        key=lambda name: (order.index(name.partition("+")[0]), name),
    )
    files = scene_files(settings, place.name, methods, home)
    missing = [
        name for name in ("velocity", "truth", "transforms") if not Path(getattr(files, name)).is_file()
    ]
    for file in (files.particles, files.binding, files.gaussians):
        existing(file, f"make it with `snakemake --cores 2 results/{place.name}/neuma/rollout.h5`")
    return settings, replace(files, **dict.fromkeys(missing))


def _known(settings: Config, method: str) -> bool:
    try:
        settings.method_title(method)
    except InputError:
        return False
    return True


def _settings_of(place: Path, configfiles: Sequence[str | Path]) -> Config:
    if configfiles:
        root = Path.cwd()
        configfiles = [root / SETTINGS, *configfiles] if (root / SETTINGS).is_file() else configfiles
    else:
        root = next((parent for parent in place.parents if (parent / SETTINGS).is_file()), None)
        if root is None:
            raise InputError(
                f"{place}: no folder above it has {SETTINGS}: it belongs to no project; give --configfile"
            )
        configfiles = [root / SETTINGS]
    raw: dict[str, Any] = {}
    for file in configfiles:
        raw = merged(raw, read_yaml(file))
    return load(raw, root)
