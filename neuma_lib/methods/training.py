"""Training of `neuma` and `structured`: bodies, initial states and losses of all videos, and the report."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import torch

from neuma_lib.config.training import TrainingConfig
from neuma_lib.coupling.bodies import join
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.fitting.frame_batches import check_contact
from neuma_lib.fitting.material import ParticleLoss, PixelLoss
from neuma_lib.io.files import listed, write_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import load_videos
from neuma_lib.io.particles import load_reconstruction, with_motion, with_motions
from neuma_lib.io.simulator import simulator
from neuma_lib.mechanics.adaptor import AdaptableLaw
from neuma_lib.methods.base import Files, FitRun, Problem
from neuma_lib.sim.bodies import Pair
from neuma_lib.splatting.observation import Observation


class Training:
    """A training on all videos of a scene.

    Args:
        inputs: files of `training_inputs`, and those of the method.
        options: as the method got them.
        settings: the same, validated.
        stamp: additional settings that a checkpoint must agree with.
        friction: Coulomb coefficient of all obstacles. None: those of the problem.
        pairs: friction of bodies that touch each other. All bodies of the inputs are then in one video.
    """

    def __init__(
        self,
        inputs: Files,
        options: Mapping[str, Any],
        settings: TrainingConfig,
        problem: Problem,
        run: FitRun,
        stamp: Mapping[str, Any] | None = None,
        friction: float | None = None,
        pairs: tuple[Pair, ...] = (),
    ):
        self.settings, self.run, self._problem = settings, run, problem
        mpm = simulator(problem.simulation)
        mpm = mpm if friction is None else mpm.with_friction(friction)
        self._mpm = replace(mpm, pairs=pairs)
        parts = zip(*(listed(inputs[name]) for name in ("particles", "binding", "gaussians")), strict=True)
        bodies = [
            load_reconstruction(*files, density, settings.particle_source, settings.gaussian_motion).to(
                torch.float32, run.device
            )
            for files, density in zip(parts, problem.densities, strict=True)
        ]
        self.counts = [len(body.x0) for body in bodies]
        if pairs:
            self.starts, bodies = [with_motions(bodies, inputs["velocity"])], [join(bodies)]
        else:
            self.starts = [
                with_motion(body, f) for body, f in zip(bodies, listed(inputs["velocity"]), strict=True)
            ]
        if settings.supervision == "particles":
            self.losses = [particle_loss(file, run.device) for file in listed(inputs["truth"])]
        else:
            self.losses = [
                pixel_loss(body, self._videos(file), settings)
                for body, file in zip(bodies, listed(inputs["transforms"]), strict=True)
            ]
        frames = [loss.frames for loss in self.losses]
        check_contact(self._mpm, zip(self.starts, frames, strict=True))
        files = {
            f"{name} {k}": file for name, value in inputs.items() for k, file in enumerate(listed(value))
        }
        known = {
            "simulation": problem.simulation,
            "exposure": problem.exposure,
            "densities": problem.densities,
            **options,
        }
        self._checkpoint = run.checkpoint(known | dict(stamp or {}), files)

    def _videos(self, transforms: str) -> list[Observation]:
        videos = load_videos(transforms, self.settings.views, **self._problem.exposure)
        return [video.to(torch.float32, self.run.device) for video in videos]

    def problem(self, law: AdaptableLaw) -> tuple:
        """Positional arguments of `train_material`."""
        return self._mpm, law, self.starts[0], self.losses[0], self.settings

    def options(self) -> dict[str, Any]:
        """Keyword arguments of `train_material`."""
        others = list(zip(self.starts[1:], self.losses[1:], strict=True))
        return {
            "checkpoint": self._checkpoint,
            "progress": self.run.progress,
            "log": self.run.log,
            "other_videos": others,
        }

    def report(self, trained) -> dict[str, Any]:
        return {name: getattr(trained, name) for name in ("best_loss", "best_iteration", "stable")}

    def write_history(self, trained, extra: Mapping[str, Any] | None = None) -> None:
        """Write the learning curves. Times are left out: equal settings give equal files."""
        curves = asdict(trained.history)
        del curves["seconds"]
        write_json(self.run.history, {**self.report(trained), **(extra or {}), **curves})

    def finish(self, trained) -> None:
        self._checkpoint.remove()
        self.run.log(trained.summary())


def particle_loss(truth: str, device: torch.device) -> ParticleLoss:
    """The loss of a ground truth."""
    arrays, _ = read_arrays(truth, required=("x", "frames"), only=("x", "frames"))
    return ParticleLoss(tuple(arrays["frames"].tolist()), torch.from_numpy(arrays["x"]).to(device))


def pixel_loss(body: Reconstruction, videos: Sequence[Observation], settings: TrainingConfig) -> PixelLoss:
    """The loss of a video."""
    total = settings.covariance_from == "total"
    return PixelLoss(body, videos, settings.covariance_gradient, total=total, compare=settings.compare)
