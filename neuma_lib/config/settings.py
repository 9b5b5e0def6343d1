"""Typed settings of the whole pipeline: one home, one type, one default and one line of explanation each.

`load` turns the merged YAML that the user gave into a `Config`; unknown keys, wrong types and impossible values are
an `InputError` that names the key by its path. The sections stand in `neuma_lib.config.sections`; a stage receives
the complete section (all defaults filled in) as plain numbers.

``docs/settings.md`` is generated from all this by `neuma_lib.config.page`.
"""

from __future__ import annotations

import copy
import difflib
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, Field, ValidationError, model_validator

from neuma_lib.config.blocks import Section
from neuma_lib.config.sections import (
    BindingConfig,
    DatasetConfig,
    EvaluationConfig,
    ExperimentConfig,
    FiguresConfig,
    GaussiansConfig,
    GeometryConfig,
    MaterialConfig,
    MethodConfig,
    PriorsConfig,
    SceneConfig,
    SimulationConfig,
    TableConfig,
    VelocityConfig,
)
from neuma_lib.errors import InputError


class Config(Section):
    """Everything."""

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
    dataset: DatasetConfig = Field(DatasetConfig(), description="ground truth and images")
    simulation: SimulationConfig = Field(SimulationConfig(), description="material point method")
    priors: PriorsConfig = Field(PriorsConfig(), description="pre-trained laws")
    gaussians: GaussiansConfig = Field(GaussiansConfig(), description="static reconstruction")
    geometry: GeometryConfig = Field(GeometryConfig(), description="mesh and particles")
    binding: BindingConfig = Field(BindingConfig(), description="Gaussians to particles")
    velocity: VelocityConfig = Field(VelocityConfig(), description="initial velocity")
    material: MaterialConfig = Field(MaterialConfig(), description="adaptation of the law")
    evaluation: EvaluationConfig = Field(EvaluationConfig(), description="measures and videos")
    figures: FiguresConfig = Field(FiguresConfig(), description="figures")
    methods: dict[str, MethodConfig] = Field({}, description="methods by name")
    experiments: dict[str, ExperimentConfig] = Field({}, description="uses of learned laws by name")
    tables: dict[str, TableConfig] = Field({}, description="tables by name")

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        for name, scene in self.scenes.items():
            if "/" not in scene.prior and "." not in scene.prior and scene.prior not in self.priors.laws:
                raise ValueError(
                    f"scenes.{name}.prior: no prior '{scene.prior}' in priors.laws"
                    + _close(scene.prior, self.priors.laws)
                )
            _overridden(self.material, scene.material, f"scenes.{name}.material")
        for name, method in self.methods.items():
            _overridden(self.material, method.material, f"methods.{name}.material")
        for name, experiment in self.experiments.items():
            for k, body in enumerate(experiment.bodies):
                if body.scene not in self.scenes:
                    where = f"experiments.{name}.bodies.{k}.scene"
                    raise ValueError(f"{where}: no scene '{body.scene}'{_close(body.scene, self.scenes)}")
        self._check_figures()
        for name, table in self.tables.items():
            for kind, known in (("scenes", self.scenes), ("experiments", self.experiments)):
                for column in getattr(table, kind):
                    if column not in known:
                        where = f"tables.{name}.{kind}"
                        raise ValueError(f"{where}: no {kind[:-1]} '{column}'{_close(column, known)}")
            for method in (*table.methods, *table.titles):
                parse_method(method, self.methods)
        return self

    def _check_figures(self) -> None:
        """That what figures show exists; names of scenes matter only where there are scenes."""
        drawn = self.figures
        scenes = {
            "particles_app": [drawn.particles_app],
            "pipeline": [drawn.pipeline],
            **{key: getattr(drawn, key) for key in ("main_res", "lora_alphav")},
            **{key: getattr(drawn, key) for key in ("gradient_analysis", "material_response")},
        }
        experiments = {
            "letters": drawn.letters,
            "meetings": drawn.meetings,
            "ext_time": [drawn.ext_time] if drawn.ext_time else [],
        }
        for chosen, known, kind in (
            (scenes if self.scenes else {}, self.scenes, "scene"),
            (experiments, self.experiments, "experiment"),
        ):
            for key, names in chosen.items():
                for name in names:
                    if name not in known:
                        raise ValueError(f"figures.{key}: no {kind} '{name}'{_close(name, known)}")

    def scene(self, name: str) -> SceneConfig:
        """The scene of that name."""
        if name not in self.scenes:
            raise InputError(f"no scene '{name}' in {self.scenes_file}{_close(name, self.scenes)}")
        return self.scenes[name]

    def experiment(self, name: str) -> ExperimentConfig:
        """The experiment of that name."""
        if name not in self.experiments:
            raise InputError(f"no experiment '{name}'{_close(name, self.experiments)}")
        return self.experiments[name]

    def experiment_bodies(self, name: str) -> list[dict[str, Any]]:
        """Complete plain descriptions of an experiment's bodies: those of their scenes, placed where it says.

        Each has ``scene``, and ``reconstructed`` for one that starts as the reconstruction of its scene's object.
        """
        found = []
        for body in self.experiment(name).bodies:
            scene = self.scene(body.scene).plain()
            keys = ("shape", "size", "height", "center", "velocity", "density", "law", "appearance")
            own = {key: value for key, value in body.plain().items() if value is not None}
            own |= {"size": body.size} if body.shape is not None else {}
            found.append({**{key: scene[key] for key in keys}, **own, "reconstructed": body.shape is None})
        return found

    def experiment_dt(self, name: str) -> float:
        """Time step of an experiment [s]."""
        experiment = self.experiment(name)
        return experiment.dt or min(self.scene(body.scene).dt for body in experiment.bodies)

    def method_density(self, scene: str, method: str) -> float | dict[str, Any]:
        """Density that a method takes the scene's body to have: the scene's, unless it assumes another."""
        assumed = self.method_material(scene, method).assumed_density
        return self.scene(scene).plain()["density"] if assumed is None else assumed

    def seeded(self, table: str, method: str, scene: str) -> list[str]:
        """The runs behind a cell of a table: the method itself, and variants of other seeds if it has several."""
        material = self.method_material(scene, method)
        random = material.train and material.rank is not None
        others = range(1, self.tables[table].seeds) if random else ()
        return [method, *(f"{method}+seed={k}" for k in others)]

    def frame_steps(self, name: str) -> tuple[int, ...]:
        """Steps of the frames of a scene's video."""
        scene = self.scene(name)
        return scene.frames or self.dataset.frame_steps(self.dataset.steps or scene.steps)

    def method_title(self, method: str) -> str:
        """Name of a method or variant for tables, for example "NeuMA, rank 4"."""
        base, variant = parse_method(method, self.methods)
        return ", ".join([self.methods[base].title, *(f"{k} {_scalar_text(v)}" for k, v in variant.items())])

    def method_prior(self, scene: str, method: str) -> str:
        """The prior that a method starts from: the scene's, unless the variant names another."""
        _, variant = parse_method(method, self.methods)
        prior = str(variant.get("prior", self.scene(scene).prior))
        if "prior" in variant and prior not in self.priors.laws:
            raise InputError(f"{method}: no prior '{prior}' in priors.laws{_close(prior, self.priors.laws)}")
        return prior

    def method_material(self, scene: str, method: str) -> MaterialConfig:
        """Effective material settings: the section, changed by the scene, then the method, then its variant."""
        base, variant = parse_method(method, self.methods)
        variant.pop("prior", None)
        section = self.material
        for changes, origin in (
            (self.scene(scene).material, f"scenes.{scene}.material"),
            (self.methods[base].material, f"methods.{base}.material"),
            (variant, method),
        ):
            section = _overridden(section, changes, origin)
        return section


def parse_method(text: str, methods: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Split a method's folder name, ``neuma+rank=4+seed=2``, into its base and its settings.

    Keys are those of the section ``material``, and ``prior``. Values are YAML scalars; a comma makes a list.

    Raises:
        InputError: unknown method or key, a repeated key, or a piece without '='.
    """
    base, *pieces = text.split("+")
    if base not in methods:
        raise InputError(f"no method '{base}'{_close(base, methods)}")
    variant: dict[str, Any] = {}
    known = [*MaterialConfig.model_fields, "prior"]
    for piece in pieces:
        key, equals, value = piece.partition("=")
        if not equals or not key or not value:
            raise InputError(f"method '{text}': write variants as +key=value, not '+{piece}'")
        if key not in known:
            raise InputError(f"method '{text}': no setting '{key}'{_close(key, known)}")
        if key in variant:
            raise InputError(f"method '{text}': '{key}' is given twice")
        kind = typing.get_origin(MaterialConfig.model_fields[key].annotation) if key != "prior" else None
        values = [yaml.safe_load(v) for v in value.split(",")]
        variant[key] = values if kind is tuple else yaml.safe_load(value)
    return base, variant


def load(raw: Mapping[str, Any], root: str | Path = ".") -> Config:
    """Validate merged settings.

    Args:
        raw: the YAML as nested dicts. ``scenes_file`` (relative to ``root``) is read, and ``scenes`` changes it.
        root: folder of the project.

    Raises:
        InputError: names every offending key by its path and suggests close matches.
    """
    raw = copy.deepcopy(dict(raw))
    scenes_file = Path(root) / str(raw.get("scenes_file", Config.model_fields["scenes_file"].default))
    scenes = read_yaml(scenes_file)
    raw["scenes"] = merged(scenes, raw.get("scenes") or {})
    return validate(Config, raw)


def validate(kind: type, raw: Any, origin: str = "") -> Any:
    """Build a section, with errors that name keys by their path below ``origin``."""
    try:
        return kind.model_validate(raw)
    except ValidationError as error:
        lines = [_explain(kind, problem, origin) for problem in error.errors()]
        raise InputError("settings: " + "\n          ".join(lines)) from None


def read_yaml(path: str | Path) -> dict[str, Any]:
    """A YAML file as a dict. Raises InputError naming the file when it is missing or not a mapping."""
    try:
        content = yaml.safe_load(Path(path).read_text())
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


def pick(kind: type, section: Section | Mapping[str, Any], **others: Any) -> Any:
    """Build the dataclass ``kind`` from the fields of the same names; ``others`` are given by hand."""
    values = (
        section
        if isinstance(section, Mapping)
        else {k: getattr(section, k) for k in type(section).model_fields}
    )
    return kind(
        **{f.name: values[f.name] for f in fields(kind) if f.name in values and f.name not in others},
        **others,
    )


def from_mapping(kind: type, values: Mapping[str, Any], origin: str) -> Any:
    """Build the dataclass ``kind`` from a block of settings, blocks inside it too; lists become tuples.

    Raises:
        InputError: an unknown key, named by its path below ``origin``.
    """
    known = {f.name: f for f in fields(kind)}
    built = {}
    for key, value in values.items():
        if key not in known:
            raise InputError(f"settings: {origin}.{key}: unknown key{_close(key, known)}")
        if isinstance(value, Mapping) and is_dataclass(known[key].default):
            value = from_mapping(type(known[key].default), value, f"{origin}.{key}")
        built[key] = tuple(value) if isinstance(value, list) else value
    return kind(**built)


def _overridden(section: MaterialConfig, changes: Mapping[str, Any], origin: str) -> MaterialConfig:
    return validate(type(section), merged(section.plain(), changes), origin)


def _close(word: str, known: Any) -> str:
    """A hint: the close matches, or all that there is."""
    matches = difflib.get_close_matches(str(word), [str(k) for k in known], n=2, cutoff=0.6)
    if matches:
        return f"; did you mean {' or '.join(matches)}?"
    return f"; known: {', '.join(map(str, known))}" if known else ""


def _scalar_text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def _explain(kind: type, problem: Mapping[str, Any], origin: str) -> str:
    where = [str(p) for p in problem["loc"]]
    path = ".".join([origin, *where] if origin else where)
    if problem["type"] == "extra_forbidden":
        siblings = _keys_at(kind, problem["loc"][:-1])
        return f"{path}: unknown key{_close(where[-1], siblings)}"
    if problem["type"] == "missing":
        return f"{path}: this key is missing"
    message = problem["msg"].removeprefix("Value error, ").removeprefix("settings: ")
    if not path:
        return message
    given = problem.get("input")
    return f"{path}: {message}" + (f" (given: {given!r})" if not isinstance(given, Mapping) else "")


def _keys_at(kind: type, where: tuple) -> list[str]:
    """Keys of the section at a path, for suggestions."""
    for step in where:
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            if step not in kind.model_fields:
                return []
            kind = kind.model_fields[step].annotation
        elif typing.get_origin(kind) is dict:
            kind = typing.get_args(kind)[1]
        else:
            return []
    return list(kind.model_fields) if isinstance(kind, type) and issubclass(kind, BaseModel) else []
