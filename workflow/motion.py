"""The method of a job, its files and its model, for scripts of fits and predictions."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.device import choose_device
from neuma_lib.errors import InputError
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.io.files import listed, read_json
from neuma_lib.io.images import load_videos
from neuma_lib.io.particles import load_reconstruction
from neuma_lib.io.simulator import simulator
from neuma_lib.mechanics.law import Law
from neuma_lib.methods.base import FitRun, Method, method_of
from neuma_lib.methods.model import LawOnGrid, MotionModel
from neuma_lib.sim.model import MPM
from neuma_lib.sim.state import State
from neuma_lib.splatting.observation import Observation
from workflow.provenance import fingerprint
from workflow.stage import Stage

BODY = ("particles", "binding", "gaussians")
START = (*BODY, "velocity")


class FitStage(FitRun):
    """A fit as a stage of the workflow.

    Args:
        product, history: files to write.
        checkpoint: file that keeps the state of an interrupted fit.
        device: of the settings.
        code: digest of the code behind the job.
        stage: shows progress.
    """

    def __init__(self, product: str, history: str, checkpoint: str, device: str, code: str, stage: Stage):
        self.product, self.history = Path(product), Path(history)
        self.device = choose_device(device)
        self._checkpoint, self._code, self._stage = checkpoint, code, stage

    def checkpoint(self, settings: Mapping[str, Any], inputs: Mapping[str, Any]) -> Checkpoint:
        files = {
            f"{name} {k}": file for name, value in inputs.items() for k, file in enumerate(listed(value))
        }
        return Checkpoint(self._checkpoint, fingerprint(settings, files, self._code))

    def progress(self, done: int, total: int, loss: float | None = None) -> None:
        self._stage.progress(done, total, loss)

    def log(self, text: str) -> None:
        self._stage.log(text)


def simulators(params) -> list[MPM]:
    """The simulator of each of the scenes of a job."""
    several = params.simulation if isinstance(params.simulation, list) else [params.simulation]
    return [simulator(own) for own in several]


def filmed_bodies(
    inputs, params, settings: IdentifyConfig, device: torch.device
) -> list[tuple[InitialMotion, Reconstruction, list[Observation]]]:
    """Initial motion, body and videos of each of the scenes of a job."""
    names = (*BODY, "velocity", "transforms")
    kind: Any = dict(dtype=torch.float32, device=device)
    return [
        (
            InitialMotion.of(read_json(velocity)),
            load_reconstruction(*body, density, gaussian_motion=settings.gaussian_motion).to(**kind),
            [video.to(**kind) for video in load_videos(transforms, settings.views, **params.exposure)],
        )
        for *body, velocity, transforms, density in zip(
            *(listed(inputs[name]) for name in names), params.densities, strict=True
        )
    ]


def files_of(inputs, names: Iterable[str]) -> dict[str, Any]:
    """Named input files of a job: one path, or a list of several."""
    files = {name: listed(inputs[name]) for name in names}
    return {name: paths[0] if len(paths) == 1 else paths for name, paths in files.items()}


class Prediction:
    """The model of a job that predicts a motion.

    Args:
        inputs: of the job: the reconstructed body, and the files of the model, one path a body.
        method: parameter of the job: ``module`` of the method, names of its ``files`` among the inputs, and
            ``options``, one entry a body.
    """

    def __init__(self, inputs, method: Mapping[str, Any]):
        self.method: Method = method_of(method["module"])
        self._inputs, self._options = inputs, method["options"]
        by_name = {name: listed(inputs[name]) for name in method["files"]}
        self._files = [{name: by_name[name][k] for name in by_name} for k in range(len(self._options))]

    def start(self, densities: list, particle_source: str) -> tuple[State, list[int]]:
        """Particles in motion, and how many belong to each body."""
        files = self._files[0] | {name: self._inputs[name] for name in START}
        return self.method.load_initial_state(files, self._options[0], densities, particle_source)

    def model(self, dt: float, counts: list[int] | None = None) -> MotionModel:
        """The model of all bodies, at a time step [s]."""
        pairs = zip(self._files, self._options, strict=True)
        models = [self.method.load(files, options, dt) for files, options in pairs]
        return LawOnGrid.together(models, counts)

    def law(self, dt: float) -> Law:
        """The law of a job about one law. Raises InputError if the motion follows from no law."""
        law = self.model(dt).law
        if law is None:
            problem = "its motion follows from no material law"
            raise InputError(self.method.name, problem, "Choose another method")
        return law

    def body(self, density, particle_source: str, gaussian_motion: str, device: torch.device):
        """The body that renders the motion."""
        files = self._files[0] | {name: self._inputs[name] for name in START[:3]}
        return self.method.load_reconstruction(
            files, self._options[0], density, particle_source, gaussian_motion, device
        )
