"""`load` turns the merged YAML that the user gave into a `Config`.

On the way scenes are read from their table, drawn at random, or completed by those that they are like.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from neuma_lib.config.priors import PriorsConfig
from neuma_lib.config.simulation import SimulationConfig
from neuma_lib.config.validation import hint, validate
from neuma_lib.errors import InputError
from neuma_lib.extensions import load_laws
from neuma_lib.methods.registry import built_in_presets
from neuma_lib.project.cases import law_from
from neuma_lib.project.random_scenes import RandomConfig, draw_scenes
from neuma_lib.project.settings import Config

RENAMED = {
    "law": "renamed to kind: neuma or prior (learned), constants (identified), structured, true_law (true), "
    "spring_gaus (springs) or pac_nerf",
    "material": "renamed to options",
    "structured": "renamed to options, which has the options of all parts of the method",
    "springs": "renamed to options, which has the options of all parts of the method",
    "pac_nerf": "renamed to options, which has the options of all parts of the method",
    "prior": "moved to options.prior",
    "trained_as": "renamed to same_fit_as",
    "judged_on": "renamed to evaluate_on",
}
"""Keys of `methods` in former versions."""


def load(
    raw: Mapping[str, Any], root: str | Path = ".", captured: Mapping[str, Mapping[str, Any]] | None = None
) -> Config:
    """Validate merged settings.

    Args:
        raw: the YAML as nested dicts. ``scenes_file`` (relative to ``root``) is read, random scenes are drawn, and
            ``scenes`` changes both.
        root: folder of the project.
        captured: scenes of captures (`neuma_lib.project.capture_scenes`), which ``scenes`` may change as well.

    Raises:
        InputError: names every offending key by its path and suggests close matches.
    """
    scenes_file = Path(root) / str(raw.get("scenes_file", Config.model_fields["scenes_file"].default))
    scenes, changes = {**read_yaml(scenes_file), **_random_scenes(raw)}, raw.get("scenes") or {}
    for name in captured or {}:
        if name in scenes:
            raise InputError(
                f"a capture makes the scene '{name}', and another scene is named so: rename its folder"
            )
    scenes |= captured or {}
    if isinstance(changes, Mapping):
        changes = _complete(_with_throws(merged(scenes, changes)))
    extensions = _extensions(raw, root)
    presets = merged(built_in_presets(extensions), _presets(raw))
    settings = validate(Config, {**raw, "extensions": extensions, "scenes": changes, "methods": presets})
    check_methods(settings)
    return settings


def check_methods(settings: Config) -> None:
    """Check the presets and variants that tables, figures and the demo name. Raises InputError naming the key."""
    figures, demo = settings.figures, settings.demo
    named = {"figures.beside": figures.beside}
    named["random.methods"] = settings.random.methods if settings.random.count else ()
    named["demo.methods"] = demo.methods if "demo" in settings.model_fields_set else ()
    for name, table in settings.tables.items():
        named[f"tables.{name}"] = (*table.methods, *table.titles)
    for where, methods in named.items():
        for method in methods:
            try:
                law_from(settings, method)
            except InputError as error:
                raise InputError(where, str(error)) from None


def _extensions(raw: Mapping[str, Any], root: str | Path) -> tuple[str, ...]:
    """Paths of the extensions, which are loaded."""
    files = raw.get("extensions") or ()
    if not isinstance(files, list | tuple) or not all(isinstance(file, str) for file in files):
        raise InputError("extensions", f"{files!r} is not a list of Python files", "Write [my_method.py]")
    paths = tuple(str(Path(root) / file) for file in files)
    load_laws(paths)
    return paths


def _presets(raw: Mapping[str, Any]) -> Mapping[str, Any]:
    """The user's presets. Raises InputError for keys of former versions."""
    presets = raw.get("methods") or {}
    for name, preset in presets.items() if isinstance(presets, Mapping) else ():
        for key in preset if isinstance(preset, Mapping) else ():
            if key in RENAMED:
                raise InputError(f"methods.{name}.{key}", f"was {RENAMED[key]}")
    return presets


def _random_scenes(raw: Mapping[str, Any]) -> dict[str, Any]:
    """Random scenes; none where the settings behind them have mistakes, which are reported with all others."""
    kinds = {"random": RandomConfig, "priors": PriorsConfig, "simulation": SimulationConfig}
    try:
        random, priors, simulation = (validate(kind, raw.get(key, {}), key) for key, kind in kinds.items())
    except InputError:
        return {}
    return draw_scenes(random, priors.laws, simulation.grid, simulation.gravity)


def _with_throws(scenes: Mapping[str, Any]) -> dict[str, Any]:
    """Scenes, and beside them the throws of their objects that their ``videos`` describe in place."""
    found = dict(scenes)
    for name, scene in scenes.items():
        videos = scene.get("videos") if isinstance(scene, Mapping) else None
        if not isinstance(videos, list):
            continue
        names = [f"{name}_throw{k}" if isinstance(v, Mapping) else v for k, v in enumerate(videos, 2)]
        for throw, video in zip(names, videos, strict=True):
            if isinstance(video, Mapping):
                if throw in found:
                    raise InputError(
                        f"settings: scenes.{name}.videos makes {throw}, which is another scene: rename it"
                    )
                found[throw] = {"like": name, **video}
        found[name] = {**scene, "videos": names}
    return found


def _complete(scenes: Mapping[str, Any]) -> dict[str, Any]:
    """Scenes of which those that are like another one have its settings where they have none of their own."""

    def complete(name: str, asked: tuple[str, ...] = ()) -> Any:
        scene = scenes[name]
        like = scene.get("like") if isinstance(scene, Mapping) else None
        if like is None:
            return scene
        if like not in scenes:
            raise InputError(f"settings: scenes.{name}.like: no scene '{like}'{hint(like, scenes)}")
        if like in (name, *asked):
            raise InputError(f"settings: scenes.{name}.like: {like} is in turn like {name}")
        base = complete(like, (name, *asked))
        return merged({key: value for key, value in base.items() if key != "videos"}, scene)

    return {name: complete(name) for name in scenes}


def read_yaml(path: str | Path) -> dict[str, Any]:
    """A YAML file as a dict. Raises InputError naming the file when it is missing or not a mapping."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the same values, several times as fast
    try:
        content = yaml.load(Path(path).read_text(), Loader=loader)
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
