"""`load` converts merged YAML into a `Config`. It reads, draws and completes the scenes on the way."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuma_lib.config.capture import CapturesConfig
from neuma_lib.config.priors import PriorsConfig
from neuma_lib.config.scenes import SceneConfig
from neuma_lib.config.simulation import SimulationConfig
from neuma_lib.config.validation import hint, validate, with_advanced
from neuma_lib.errors import InputError
from neuma_lib.extensions import load_laws
from neuma_lib.io.yaml_files import load_yaml
from neuma_lib.methods.registry import built_in_presets
from neuma_lib.project.consistency import check_consistency
from neuma_lib.project.random_piles import draw_piles, without_first
from neuma_lib.project.random_scenes import RandomConfig, draw_scenes
from neuma_lib.project.renames import refuse_old_keys
from neuma_lib.project.settings import Config


def load(
    raw: Mapping[str, Any], root: str | Path = ".", captured: Mapping[str, Mapping[str, Any]] | None = None
) -> Config:
    """Validate merged settings.

    Args:
        raw: the YAML as nested dicts. ``scenes_file`` (relative to ``root``) is read, random scenes are drawn, and
            ``scenes`` changes both.
        captured: scenes of captures (`neuma_lib.project.capture_scenes`), which ``scenes`` may change as well.

    Raises:
        InputError: names every wrong key by its path and suggests close matches.
    """
    refuse_old_keys(raw)
    raw = with_advanced(Config, raw)
    scenes_file = Path(root) / str(raw.get("scenes_file", Config.model_fields["scenes_file"].default))
    named = read_yaml(scenes_file)
    refuse_old_keys({"scenes": named})
    scenes, changes = dict(named), raw.get("scenes") or {}
    random = _random_scenes(raw)
    for kind, others in {"random settings have": random, "a capture has": captured or {}}.items():
        for name in others.keys() & scenes.keys():
            raise InputError(f"scenes.{name}", f"{kind} a scene of this name", "Rename one of the two")
        scenes |= others
    if isinstance(changes, Mapping):
        changes = _with_parts(_complete(_with_takes(merged(scenes, changes))))
    extensions = _extensions(raw, root)
    presets = raw.get("methods") or {}
    if isinstance(presets, Mapping):
        presets = merged(built_in_presets(extensions), presets)
    experiments = raw.get("experiments") or {}
    if isinstance(experiments, Mapping):
        experiments = without_first(random) | {**experiments}
    complete = {"extensions": extensions, "scenes": changes, "methods": presets, "experiments": experiments}
    settings = validate(Config, {**raw, **complete})
    check_consistency(settings, root)
    return settings


def load_captures(raw: Mapping[str, Any]) -> CapturesConfig:
    """The section ``captures`` of merged settings, which `load` needs for the scenes of captures."""
    return validate(CapturesConfig, with_advanced(Config, raw).get("captures") or {}, "captures")


def _extensions(raw: Mapping[str, Any], root: str | Path) -> tuple[str, ...]:
    """Paths of the extensions, which are loaded."""
    files = raw.get("extensions") or ()
    if not isinstance(files, list | tuple) or not all(
        isinstance(file, str) and file.endswith(".py") for file in files
    ):
        raise InputError("extensions", f"{files!r} is not a list of Python files", "Write [my_method.py]")
    paths = tuple(str(Path(root) / file) for file in files)
    load_laws(paths)
    return paths


def _random_scenes(raw: Mapping[str, Any]) -> dict[str, Any]:
    """Random scenes. Empty if their settings are invalid, which `load` reports with all other problems."""
    kinds = {"random": RandomConfig, "priors": PriorsConfig, "simulation": SimulationConfig}
    try:
        random, priors, simulation = (validate(kind, raw.get(key, {}), key) for key, kind in kinds.items())
    except InputError:
        return {}
    draw = draw_piles if random.bodies else draw_scenes
    return draw(random, priors.laws, simulation.grid, simulation.gravity)


def _with_takes(scenes: Mapping[str, Any]) -> dict[str, Any]:
    """Scenes, and a scene for each take of an object that ``videos`` describes in place."""
    complete = dict(scenes)
    for name, scene in scenes.items():
        videos = scene.get("videos") if isinstance(scene, Mapping) else None
        if not isinstance(videos, list):
            continue
        names = [f"{name}_throw{k}" if isinstance(v, Mapping) else v for k, v in enumerate(videos, 2)]
        for take, video in zip(names, videos, strict=True):
            if isinstance(video, Mapping):
                if take in complete:
                    problem = f"the name {take} of a video is that of another scene"
                    raise InputError(f"scenes.{name}.videos", problem, "Rename the scene")
                complete[take] = {"like": name, **video}
        complete[name] = {**scene, "videos": names}
    return complete


OF_ALL_BODIES = ("truth", "dt", "steps", "frames", "prior", "colliders", "friction", "training")
"""Keys of a scene of several bodies that the scenes of its bodies share."""


def _with_parts(scenes: Mapping[str, Any]) -> dict[str, Any]:
    """Scenes, and a scene ``<name>_<body>`` for each body of those with several.

    There are none for an invalid scene, which `load` reports.
    """
    complete = dict(scenes)
    for name, scene in scenes.items():
        if not isinstance(scene, Mapping) or not scene.get("bodies"):
            continue
        try:
            pile = validate(SceneConfig, scene, f"scenes.{name}").plain()
        except InputError:
            continue
        shared = {key: pile[key] for key in OF_ALL_BODIES}
        for key, body in pile["bodies"].items():
            part = f"{name}_{key}"
            if part in scenes:
                problem = f"the scene of the body {key} is called {part}, as another scene"
                raise InputError(f"scenes.{name}.bodies.{key}", problem, "Rename one of the two")
            known = {field: value for field, value in body.items() if field in SceneConfig.model_fields}
            if captured := pile["captured"]:
                known["captured"] = {**captured, "capture": f"{captured['capture']}_{key}"}
            complete[part] = {**shared, **known, "part_of": [name, key]}
    return complete


def _complete(scenes: Mapping[str, Any]) -> dict[str, Any]:
    """Scenes in which those with ``like`` inherit the settings of that scene that they do not set."""

    def complete(name: str, asked: tuple[str, ...] = ()) -> Any:
        scene = scenes[name]
        like = scene.get("like") if isinstance(scene, Mapping) else None
        if like is None:
            return scene
        if not isinstance(like, str) or like not in scenes:
            raise InputError(f"scenes.{name}.like", f"no scene '{like}'{hint(like, scenes)}")
        if like in (name, *asked):
            raise InputError(f"scenes.{name}.like", f"{like} is in turn like {name}")
        base = complete(like, (name, *asked))
        return merged({key: value for key, value in base.items() if key != "videos"}, scene)

    return {name: complete(name) for name in scenes}


def read_yaml(path: str | Path) -> dict[str, Any]:
    """A YAML file as a dict. Raises InputError as `load_yaml`, or if it is no mapping."""
    content = load_yaml(path, "Give the path of an existing settings file")
    if not isinstance(content or {}, dict):
        raise InputError(path, f"expected lines 'key: value', not a {type(content).__name__}")
    return content or {}


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` updated by ``changes``: nested dicts are merged, other values replaced."""
    result = dict(base)
    for key, value in changes.items():
        old = result.get(key)
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        result[key] = merged(old, value) if both else value
    return result
