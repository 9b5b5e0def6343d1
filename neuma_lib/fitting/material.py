"""Grounding of the material law in the video (paper Sec. 3.2-3.4): low-rank corrections of both networks from pixels.

The loss of a video is the mean over its frames. Several videos of one material have equal weights. The method and its
ablations use the same loop with different options:

==============================  =======================================================================
NeuMA                           rank-16 adaptor, `PixelLoss`, reconstructed body
NeuMA w/ particle supervision   rank-16 adaptor, `ParticleLoss`, reconstructed body
NeuMA w/o Bind                  rank-16 adaptor, `PixelLoss`, the Gaussians as particles
NeuMA w/o dM                    full-rank adaptor (the base weights themselves), `PixelLoss`, reconstructed body
==============================  =======================================================================
"""

from __future__ import annotations

import copy
import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any, Protocol

import torch
from torch import Tensor

from neuma_lib.config.base import Compared
from neuma_lib.config.training import TrainingConfig
from neuma_lib.coupling.filmed import Filmed
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.frame_batches import evaluate_in_batches
from neuma_lib.fitting.training_loop import TrainingLoop
from neuma_lib.geometry.chamfer import chamfer_loss
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.model import MPM, MaterialRegion
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State, Trajectory
from neuma_lib.splatting.observation import Observation, joint_frames, rendered_steps, select_frames, several

_CHAOTIC = 1e4
"""Norm of the first gradient of the loss relative to its first value, above which small differences grow.

In Table 1, norms are at most 60, except with one prior on HoneyBottle, where they are at least 1e8.
"""

_LOGGER = logging.getLogger(__name__)


class TrajectoryLoss(Protocol):
    """Training loss: one number per frame from a simulated trajectory.

    Attributes:
        frames: steps of the frames.
        steps: steps whose states it needs, including the frames and all steps of exposures.
        total: whether it needs the total deformation of the trajectory.
    """

    @property
    def frames(self) -> tuple[int, ...]: ...

    @property
    def steps(self) -> tuple[int, ...]: ...

    @property
    def total(self) -> bool: ...

    def __call__(self, path: Trajectory) -> Tensor:
        """Losses of the frames, shape (T,), of a trajectory at the steps."""

    def select(self, keep: Sequence[int]) -> TrajectoryLoss:
        """The loss restricted to the frames with the given indices."""

    def later(self, step: int) -> TrajectoryLoss:
        """The loss for a trajectory that starts at ``step`` of this one."""


@dataclass
class PixelLoss:
    """Mean squared colour difference of each frame over all training views (paper Eq. 2).

    If cameras differ in times, sizes or exposures, every step with an image of some camera is a frame, whose loss is
    the mean over its images, each the mean over its pixels.

    Attributes:
        body: the reconstruction to render.
        observation: the video, or several of one motion.
        covariance_gradient: whether gradients reach the deformation gradients through the covariances.
        frames_per_batch: frames rendered at a time, forward and backward, by default as many as moderate memory
            permits. The value does not depend on it.
        total: whether the total deformation deforms the Gaussians, instead of its elastic part.
        compare: colours, or masks only.
    """

    body: Reconstruction
    observation: Observation | Sequence[Observation]
    covariance_gradient: bool = True
    frames_per_batch: int | None = None
    total: bool = False
    compare: Compared = "colour"

    def __post_init__(self):
        self.videos = several(self.observation)
        self.frames, self.steps = joint_frames(self.videos), rendered_steps(self.videos)
        options = {"covariance_gradient": self.covariance_gradient}
        self._filmed = [
            Filmed(self.body.particle_gs(video.cameras, **options), video, self.steps, self.compare)
            for video in self.videos
        ]

    def __call__(self, path: Trajectory) -> Tensor:
        if len(path.x) != len(self.steps):
            problem = f"{len(path.x)} states must be those of {len(self.steps)} rendered steps"
            raise InputError("pixel loss", problem)
        if len(self.videos) == 1:
            return self._of(0, path)
        total, count = path.x.new_zeros(2, len(self.frames))
        for k, video in enumerate(self.videos):
            at = torch.tensor([self.frames.index(n) for n in video.frames], device=total.device)
            views = len(video.cameras)
            total = total.index_add(0, at, views * self._of(k, path))
            count = count.index_add(0, at, torch.full_like(count[at], views))
        return total / count

    def select(self, keep: Sequence[int]) -> PixelLoss:
        return replace(self, observation=select_frames(self.videos, [self.frames[k] for k in keep]))

    def later(self, step: int) -> PixelLoss:
        earlier = [
            replace(video, frames=tuple(frame - step for frame in video.frames)) for video in self.videos
        ]
        return replace(self, observation=earlier)

    def _of(self, k: int, path: Trajectory) -> Tensor:
        """Losses of the frames of a video."""
        video, filmed = self.videos[k], self._filmed[k]

        def losses(part: slice, x: Tensor, F: Tensor) -> Tensor:
            observed = video.stored(part) if self.compare == "colour" else video.coverage(part)
            return filmed.error(x, F, observed, part)

        states = (filmed.states(path.x), filmed.states(path.stretch))
        return evaluate_in_batches(losses, self.frames_per_batch or filmed.error_batch, *states)


@dataclass
class ParticleLoss:
    """Chamfer distance of each frame to ground-truth particles (the w/ P.S. ablation).

    Attributes:
        frames: steps of the frames.
        targets: ground-truth positions [m], shape (T, M, 3).
    """

    frames: tuple[int, ...]
    targets: Tensor

    @property
    def total(self) -> bool:
        return False

    @property
    def steps(self) -> tuple[int, ...]:
        return self.frames

    def __call__(self, path: Trajectory) -> Tensor:
        return chamfer_loss(path.x, self.targets)

    def select(self, keep: Sequence[int]) -> ParticleLoss:
        return ParticleLoss(tuple(self.frames[k] for k in keep), self.targets[list(keep)])

    def later(self, step: int) -> ParticleLoss:
        return ParticleLoss(tuple(frame - step for frame in self.frames), self.targets)


@dataclass
class History:
    """Training curves with one entry per accepted iteration; ``seconds`` is its wall time [s]."""

    loss: list[float] = field(default_factory=list)
    weighted_loss: list[float] = field(default_factory=list)
    gradient_norm_elastic: list[float] = field(default_factory=list)
    gradient_norm_plastic: list[float] = field(default_factory=list)
    lr_scale: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    recoveries: list[dict] = field(default_factory=list)


@dataclass
class Stretch:
    """Position of a training within a longer one whose schedules it follows.

    Attributes:
        before, after: iterations of the whole training before and after this one.
        memory: `TrainedMaterial.memory` of the preceding training, or None.
    """

    before: int = 0
    after: int = 0
    memory: dict[str, Any] | None = None


@dataclass
class TrainedMaterial:
    """Result of `train_material`: the law at its best training loss, the training curves, and whether it was stable.

    ``memory`` holds values for a following training: the averages of the optimiser by name of the parameter, and the
    first loss.
    """

    law: Law
    history: History
    best_loss: float
    best_iteration: int
    stable: bool
    memory: dict[str, Any] | None = None

    def summary(self) -> str:
        """Summary line for the log."""
        if not self.history.seconds:
            return f"nothing trained, loss {self.best_loss:.3e}"
        first = self.history.loss[0]
        note = "" if self.stable else "; UNSTABLE, best state kept"
        recoveries = f", {len(self.history.recoveries)} recoveries" if self.history.recoveries else ""
        return (
            f"loss {first:.3e} -> {self.best_loss:.3e} (x{first / max(self.best_loss, 1e-30):.1f} lower) "
            f"at iteration {self.best_iteration}{recoveries}, {median(self.history.seconds):.3g} s per iteration{note}"
        )


def frame_weights(iteration: int, count: int, settings: TrainingConfig) -> Tensor:
    """Weights (count,) of the frames: d^k for period k of the video; d rises to 1 in the first third of training."""
    rise = min(1.0, iteration / max(1.0, settings.iterations / 3))
    d = settings.frame_weight_start + (1 - settings.frame_weight_start) * rise
    part = torch.arange(count) * settings.frame_weight_periods // max(count, 1)
    return d ** part.to(torch.get_default_dtype())


def weighted_mean(losses: Tensor, iteration: int, settings: TrainingConfig) -> Tensor:
    """Mean over the frames of a video with `frame_weights`."""
    weights = frame_weights(iteration, len(losses), settings).to(losses)
    return (weights * losses).sum() / weights.sum()


Surrounded = Callable[[Law], Law | Sequence[MaterialRegion]]
"""The laws of all particles, from that of the body in training."""


def alone(law: Law) -> Law:
    """`Surrounded` for one body."""
    return law


def train_material(
    model: MPM,
    law: Law,
    start: State,
    loss: TrajectoryLoss,
    settings: TrainingConfig,
    *,
    other_videos: Sequence[tuple[State, TrajectoryLoss]] = (),
    stretch: Stretch | None = None,
    checkpoint: Checkpoint | None = None,
    progress: Callable[[int, int, float], None] | None = None,
    log: Callable[[str], None] = print,
    surrounded: Surrounded = alone,
) -> TrainedMaterial:
    """Optimise the trainable parameters of a law so that rollouts match the frames of a video.

    Args:
        model: simulator constants.
        law: prior with an adaptor, whose parameters that require gradients are optimised in place.
        start: particles with their initial motion.
        loss: per-frame loss of a trajectory.
        other_videos: initial states and losses of other videos of the same material.
        settings: hyper-parameters.
        stretch: position within a longer training, or None.
        checkpoint: file for the state of the loop, so that an interrupted run can resume; None for none.
        progress: called with (iteration, iterations, loss).
        log: receives a line for every recovery from a diverging step.
        surrounded: the laws of all particles of a start, from that of the body in training.

    Raises:
        NonFiniteError: the first rollout is not finite, so there is no state to return to.
        InputError: the law has no trainable parameters, or is initially too stiff for the time step.
    """
    videos = [(start, loss), *other_videos]
    stretch = stretch or Stretch()
    # A trained law may exceed the limit, which has a margin, because diverging steps are reverted.
    if not stretch.before:
        model.check_courant(law, min(float(start.density.min()) for start, _ in videos))
    law.set_adjoint_precision(settings.adjoint_precision)
    loop = _Loop(model, law, videos, settings, log, stretch, surrounded)
    loop.run(checkpoint, progress)
    law.load_state_dict(loop.best["law"])
    return TrainedMaterial(
        law,
        loop.history,
        loop.best["loss"],
        loop.best["iteration"],
        stable=not loop.ended,
        memory=loop.memory(),
    )


class _Loop(TrainingLoop):
    """State of the training, and a training step."""

    NAME = "material"

    def __init__(self, model, law, videos, settings, log, stretch, surrounded):
        self.surrounded = surrounded
        self.model, self.law, self.videos, self.before = model, law, videos, stretch.before
        self.model_parts = {"law": law}
        whole = stretch.before + settings.iterations + stretch.after
        self.whole = settings.model_copy(update={"iterations": whole})
        self.settings, self.log = settings, log
        self.nets = {
            "elastic": [p for p in law.elasticity.parameters() if p.requires_grad],
            "plastic": [p for p in law.plasticity.parameters() if p.requires_grad],
        }
        if not any(self.nets.values()):
            problem = "it has no trainable parameters"
            raise InputError(f"law {law.name!r}", problem, "Attach an adaptor before training")
        rates = {
            "elastic": settings.lr_scale * settings.lr_elastic,
            "plastic": settings.lr_scale * settings.lr_plastic,
        }
        self.optimizer = self._adam((p, rates[k]) for k, p in self.nets.items() if p)
        memory = stretch.memory or {"averages": {}, "first_loss": None}
        for name, parameter in law.named_parameters():
            if parameter.requires_grad and name in memory["averages"]:
                self.optimizer.state[parameter] = copy.deepcopy(memory["averages"][name])
        self._begin(History(), memory["first_loss"])

    def advance(self) -> None:
        started = time.perf_counter()
        try:
            frame_losses = self._frame_losses()
            value = _mean(frame_losses)
            if not math.isfinite(value):
                raise NonFiniteError("material", f"the loss is not finite at iteration {self.iteration}")
            if value > self.settings.diverged_ratio * max(self.best["loss"], 1e-12):
                problem = f"loss {value:.3e} against a best of {self.best['loss']:.3e}"
                raise NonFiniteError("material", problem)
            # Copied before the backward pass, which changes accumulated gradients, but kept only if that succeeds.
            best = self._better_state(value)
            norms, weighted = self._backward(frame_losses)
        except NonFiniteError as error:
            self._recover(error)
            return
        self.best = best
        self._step()
        self.history.loss.append(value)
        self.history.weighted_loss.append(weighted)
        self.history.gradient_norm_elastic.append(norms.get("elastic", 0.0))
        self.history.gradient_norm_plastic.append(norms.get("plastic", 0.0))
        self.history.lr_scale.append(self.lr_scale)
        self.history.seconds.append(time.perf_counter() - started)
        self.lr_scale = min(1.0, self.lr_scale * self.settings.recovery_growth)
        self.iteration += 1

    def _mean_loss(self) -> float:
        return _mean(self._frame_losses())

    def _frame_losses(self) -> list[Tensor]:
        """Losses of the frames of every video, shape (T,) each."""
        return [loss(self._path(start, loss)) for start, loss in self.videos]

    def _path(self, start: State, loss: TrajectoryLoss) -> Trajectory:
        memory = None if self.settings.memory is None else self.settings.memory * 2**30 / len(self.videos)
        return rollout(
            self.model,
            self.surrounded(self.law),
            start,
            steps=loss.steps[-1],
            frames=loss.steps,
            total=loss.total,
            memory=memory,
        )

    def _backward(self, frame_losses: Sequence[Tensor]) -> tuple[dict[str, float], float]:
        if self.first_loss is None:
            self.first_loss = _mean(frame_losses)
        iteration = self.before + self.iteration
        weighted = torch.stack([weighted_mean(one, iteration, self.whole) for one in frame_losses]).mean()
        if self.settings.zero_gradients:
            self.optimizer.zero_grad(set_to_none=True)
        (weighted / max(self.first_loss, 1e-30)).backward()
        norms = {name: self._clip_gradients(p, name) for name, p in self.nets.items() if p}
        if iteration == 0 and (largest := max(norms.values())) > _CHAOTIC:
            _LOGGER.warning(
                f"the first gradient has a norm of {largest:.1e}: the motion of law {self.law.name!r} amplifies small "
                "differences, so that the training may fail. If it is a trained prior, try one of another seed"
            )
        return norms, float(weighted.detach())

    def _step(self) -> None:
        iteration = self.before + self.iteration
        warm_up = min(1.0, (iteration + 1) / max(1, self.whole.warm_up))
        self._set_rates(iteration, self.whole.iterations, warm_up)
        self.optimizer.step()

    def memory(self) -> dict[str, Any]:
        """See `TrainedMaterial`."""
        state = self.optimizer.state
        averages = {name: copy.deepcopy(state[p]) for name, p in self.law.named_parameters() if p in state}
        return {"averages": averages, "first_loss": self.first_loss}

    def _snapshot(self) -> dict:
        gradients = [None if p.grad is None else p.grad.clone() for p in self._parameters()]
        return {**super()._snapshot(), "gradients": gradients}

    def _restore(self, state: dict) -> None:
        super()._restore(state)
        for parameter, gradient in zip(self._parameters(), state["gradients"], strict=True):
            # Relevant if gradients are not zeroed. A checkpoint may be from another device.
            parameter.grad = None if gradient is None else gradient.to(parameter, copy=True)

    def _parameters(self) -> list[torch.nn.Parameter]:
        return [p for parameters in self.nets.values() for p in parameters]


def _mean(frame_losses: Sequence[Tensor]) -> float:
    """Mean over the videos of the mean over their frames."""
    return float(torch.stack([losses.detach().mean() for losses in frame_losses]).mean())
