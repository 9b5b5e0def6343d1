"""Interface of methods: how a model of motion is obtained from a scene.

A method is one subclass of `Method` in one file. `neuma_lib.methods.registry` lists the built-in ones. Importing this
module, or the module of a method, loads no torch, so that settings are read and jobs are planned without it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from neuma_lib.config.base import Section
from neuma_lib.config.motion import MotionOptions
from neuma_lib.errors import InputError
from neuma_lib.extensions import load_module

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from neuma_lib.io.checkpoint import Checkpoint
    from neuma_lib.io.particles import GaussianMotion, ParticleSource
    from neuma_lib.mechanics.law import Law
    from neuma_lib.methods.model import MotionModel
    from neuma_lib.sim.state import State

Files = dict[str, Any]
"""Paths by name: one path, or a list of several."""
EvaluatedOn = Literal["particles", "training_particles"]
AS_IDENTIFIED: dict[str, Any] = {
    "covariance_from": "total",
    "gaussian_motion": "affine",
    "start": "identified",
}
"""Options with which Gaussians follow the particles as in `identify`, from the initial motion that it fitted."""


@dataclass(frozen=True)
class Preset:
    """A named set of options of a method. Its name is the name of a folder of results.

    Attributes:
        title: name in tables.
        options: values that differ from the defaults of `Method.Options`.
        note: remark on its numbers, printed below tables.
        same_fit_as: preset whose fit it takes, with its kind and options. None: its own fit.
        evaluate_on: what is simulated when it is evaluated: the particles of the body's volume, which all methods
            share, or the particles that it was fitted with.
    """

    title: str
    options: Mapping[str, Any] = field(default_factory=dict)
    note: str | None = None
    same_fit_as: str | None = None
    evaluate_on: EvaluatedOn = "particles"


class Case(ABC):
    """A preset or variant on a scene: its options, and where files are. `neuma_lib.project.cases` builds it.

    Attributes:
        scene: folder of the scene that the model is obtained from, with the seeds of its replicate.
        moved: folder of the scene whose motion is predicted. It differs from `scene` only with ``+law_from=``.
        name: preset or variant whose fit is used, for example ``neuma+rank=4``.
        options: validated, an instance of `Method.Options`.
        evaluate_on: of the preset.
        together: for a body that moves with others of a scene of several, the case of that scene and the name of the
            body there.
        bodies: for a scene of several, the cases of the scenes of its bodies by name.
    """

    scene: str
    moved: str
    name: str
    options: Any
    evaluate_on: EvaluatedOn
    together: tuple[Case, str] | None
    bodies: Mapping[str, Case]

    @abstractmethod
    def on_moved(self) -> Case:
        """The same method and options, obtained from the scene whose motion is predicted."""

    @property
    @abstractmethod
    def prior(self) -> str:
        """Name of the prior, or path of the user's own."""

    @property
    @abstractmethod
    def prior_law(self) -> dict[str, Any] | None:
        """Specification of the analytic law behind the prior. None if there is none, or the prior is the user's."""

    @property
    @abstractmethod
    def scene_law(self) -> dict[str, Any]:
        """Specification of the scene's true law. Raises InputError if the scene has none."""

    @abstractmethod
    def section(self, name: str) -> dict[str, Any]:
        """A section of the settings as plain values."""

    @abstractmethod
    def result(self, file: str) -> str:
        """Path of a file of the scene in its replicate, for example ``velocity.json``."""

    @abstractmethod
    def data(self, file: str) -> str:
        """Path of a file of the scene's data, for example ``dynamic/transforms.json``."""

    @abstractmethod
    def rollout(self) -> str:
        """Path of the predicted motion."""

    @abstractmethod
    def product(self) -> str:
        """Path of what `Method.fit` writes."""

    @abstractmethod
    def prior_file(self) -> str:
        """Path of the prior."""

    @abstractmethod
    def identified(self) -> str:
        """Name of the file of the law identified in the views of `options`."""

    @abstractmethod
    def each_video(self, choose: Callable[[Case], str]) -> str | list[str]:
        """A path of the scene of each video: one path, or a list if a scene has several videos."""


@dataclass(frozen=True)
class Problem:
    """Known quantities of a scene before a fit.

    Attributes:
        simulation: constants, as `neuma_lib.io.simulator.simulator` takes them.
        densities: density of the body of each video, as `density_at` takes it.
        exposure: how frames with an exposure are rendered, see `load_videos`.
        seed: of the project.
    """

    simulation: Mapping[str, Any]
    densities: Sequence[Any]
    exposure: Mapping[str, Any]
    seed: int = 0


class FitRun(ABC):
    """The process that a fit runs in.

    Attributes:
        device: where to compute.
        product: file of the model, to be written.
        history: JSON file of learning curves, to be written. Equal settings must give equal files: no times.
    """

    device: torch.device
    product: Path
    history: Path

    @abstractmethod
    def checkpoint(self, settings: Mapping[str, Any], inputs: Mapping[str, Any]) -> Checkpoint:
        """The saved state of a fit with these settings and input files, which an earlier process may have left."""

    @abstractmethod
    def progress(self, done: int, total: int, loss: float | None = None) -> None:
        """Report the number of finished iterations."""

    @abstractmethod
    def log(self, text: str) -> None:
        """Report a result in one line."""


@dataclass(frozen=True)
class ModelSource:
    """Files and options of a model of motion as plain values, a parameter of jobs and of the viewer.

    Attributes:
        module: module or Python file of the method.
        options: what `Method.model_options` gives.
        files: what `Method.model_inputs` gives.
        dt: time step that the model was obtained with [s].
    """

    module: str
    options: dict[str, Any]
    files: Files
    dt: float

    @property
    def paths(self) -> list[str]:
        """All files."""
        return [
            path for value in self.files.values() for path in ([value] if isinstance(value, str) else value)
        ]

    def plain(self) -> dict[str, Any]:
        return asdict(self)

    def load(self, checked: Callable[[str], str | Path] = str) -> MotionModel:
        """The model. `checked` is applied to every path."""
        files = {name: checked(path) for name, path in self.files.items()}
        return method_of(self.module).load(files, self.options, self.dt)


class Method(ABC):
    """How a model of motion is obtained from a scene. One subclass a file.

    Class attributes:
        name: the value of ``kind`` in the settings of presets.
        Options: settings that presets and names of variants (``neuma+rank=4``) may set.
        sections: sections of the settings with the defaults of these options.
        presets: built-in presets by name.
        product: file that `fit` writes. None: nothing is fitted.
        fit_kernels, kernels: groups of Warp kernels that `fit` and predictions use.
        body_kernels: groups that predictions and renderings with the files of `body_inputs` use in addition.
        draws_module: module with the function `draws`, separate from the method, so that its edits repeat no fit.
        has_law: whether the motion follows from a material law (`MotionModel.law`). Only laws move several bodies.
        fits_together: whether `fit` also takes a scene of several bodies, in the video of all.
        moves_other_bodies: whether the model moves the bodies of other scenes (``+law_from=``).
    """

    name: ClassVar[str]
    Options: ClassVar[type[Section]] = MotionOptions
    sections: ClassVar[tuple[str, ...]] = ("training",)
    presets: ClassVar[Mapping[str, Preset]] = {}
    product: ClassVar[str | None] = None
    fit_kernels: ClassVar[tuple[str, ...]] = ("laws", "rendering")
    kernels: ClassVar[tuple[str, ...]] = ("laws",)
    body_kernels: ClassVar[tuple[str, ...]] = ()
    draws_module: ClassVar[str | None] = None
    has_law: ClassVar[bool] = True
    fits_together: ClassVar[bool] = False
    moves_other_bodies: ClassVar[bool] = True

    # ---- planning, without torch

    def fit_inputs(self, case: Case) -> Files:
        """Everything that `fit` may read."""
        return {}

    @abstractmethod
    def model_inputs(self, case: Case) -> Files:
        """Files of the model, for `load`: one path a name."""

    def body_inputs(self, case: Case) -> Files:
        """Additional files of `load_initial_state` and `load_reconstruction`: one path a name."""
        return {}

    def uncertainty_inputs(self, case: Case) -> Files:
        """Files of `draws`: one path a name."""
        return {}

    def fit_options(self, case: Case) -> dict[str, Any]:
        """Options of `fit` as plain values."""
        return case.options.plain()

    def model_options(self, case: Case) -> dict[str, Any]:
        """Options of `load`, `load_initial_state` and `load_reconstruction` as plain values."""
        return {}

    def start_file(self, case: Case) -> str:
        """File of the initial motion: the estimated one, or the one that a fit contains."""
        own = case.on_moved()
        return own.result(own.identified() if own.options.start == "identified" else "velocity.json")

    def seeds(self, case: Case) -> tuple[str, ...]:
        """Seeds of a replicate that change its results. They name the folder of its runs."""
        return ("prior", "gaussians", "particles")

    def particle_source(self, case: Case) -> str:
        """What an evaluation simulates: "binding" (particles of the volume), or the particles of the fit."""
        return case.options.particle_source if case.evaluate_on == "training_particles" else "binding"

    def learns_from_video(self, case: Case) -> bool:
        """Whether the model comes from the scene itself. If not, it is the same for all scenes with one prior."""
        return True

    # ---- work, with torch

    def fit(self, inputs: Files, options: Mapping[str, Any], problem: Problem, run: FitRun) -> None:
        """Obtain the model from `inputs` and write it to ``run.product``.

        Args:
            inputs: the files of `fit_inputs`.
            options: what `fit_options` gives.
        """
        raise NotImplementedError(f"{self.name} has nothing to fit")

    @abstractmethod
    def load(self, inputs: Files, options: Mapping[str, Any], dt: float) -> MotionModel:
        """The model, from the files of `model_inputs`.

        Args:
            options: what `model_options` gives.
            dt: time step of the prediction [s].
        """

    def load_initial_state(
        self,
        inputs: Files,
        options: Mapping[str, Any],
        densities: Sequence[Any],
        particle_source: ParticleSource,
    ) -> tuple[State, list[int]]:
        """Initial state of a prediction, and the number of particles of each body.

        Args:
            inputs: ``particles``, ``binding``, ``gaussians``, ``velocity`` and the files of `body_inputs`.
            densities: of each body.
        """
        from neuma_lib.io.particles import load_initial_state

        files = (inputs[name] for name in ("particles", "binding", "gaussians", "velocity"))
        return load_initial_state(*files, densities=densities, particle_source=particle_source)

    def load_reconstruction(
        self,
        inputs: Files,
        options: Mapping[str, Any],
        density: Any,
        particle_source: ParticleSource,
        gaussian_motion: GaussianMotion,
        device: torch.device | str = "cpu",
    ) -> Any:
        """The body that renders a predicted motion, with ``particle_gs(cameras)``."""
        import torch

        from neuma_lib.io.particles import load_reconstruction

        files = (inputs[name] for name in ("particles", "binding", "gaussians"))
        body = load_reconstruction(
            *files, density=density, particle_source=particle_source, gaussian_motion=gaussian_motion
        )
        return body.to(torch.float32, device)

    def draws(
        self, inputs: Files, law: Law, F: Tensor | None, uncertainty: Mapping[str, Any], **drawn: Any
    ) -> list[Law]:
        """Laws drawn from the uncertainty that remains after the video. Empty if it is unknown.

        Args:
            inputs: the files of `uncertainty_inputs`.
            law: from `load`.
            F: deformation gradients of the motion, shape (T, N, 3, 3); None: read from `inputs`.
            uncertainty: ``model_std`` and ``spread`` of the settings of `identify`.
            drawn: ``dt`` [s], ``count`` and ``seed``, and ``body``, the name of a body that moves with others.
        """
        if self.draws_module is None:
            return []
        return load_module(self.draws_module).draws(inputs, law, F, uncertainty, **drawn)


BODY = {"particles": "particles.h5", "binding": "binding.h5", "gaussians": "gaussians.ply"}
"""Files of a reconstructed body: the particles that are simulated, the Gaussians, and what binds them."""


def body_of_each_video(case: Case) -> Files:
    """The reconstructed body of each video of a scene: particles, binding and Gaussians."""
    return {name: case.each_video(lambda each, file=file: each.result(file)) for name, file in BODY.items()}


def friction_options(case: Case) -> dict[str, Any]:
    """Options of a model with the identified friction: in other scenes obstacles with a coefficient keep it."""
    fitted = case.section("identify")["contact_friction"] == "fitted"
    return {"elsewhere": True} if fitted and case.scene != case.moved else {}


def training_inputs(case: Case) -> Files:
    """Body, supervision and initial motion of each video of a scene."""
    if case.options.supervision == "pixels":
        supervision = {"transforms": case.each_video(lambda each: each.data("dynamic/transforms.json"))}
    else:
        supervision = {"truth": case.each_video(lambda each: each.data("truth.h5"))}
    start = case.identified() if case.options.start == "identified" else "velocity.json"
    return {
        **body_of_each_video(case),
        **supervision,
        "velocity": case.each_video(lambda each: each.result(start)),
    }


def methods_in(module: str) -> list[Method]:
    """The methods that a module or a Python file defines."""
    return [
        value()
        for value in vars(load_module(module)).values()
        if isinstance(value, type) and issubclass(value, Method) and value.__module__ == module
    ]


def method_of(module: str) -> Method:
    """The method that a module or a Python file defines.

    Raises:
        InputError: it does not define exactly one.
    """
    methods = methods_in(module)
    if len(methods) != 1:
        raise InputError(module, f"it defines {len(methods)} methods", "Define one method in a file")
    return methods[0]
