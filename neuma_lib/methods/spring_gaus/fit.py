"""Fit of a network of springs to a video (Spring-Gaus, Zhong et al. 2024, stage "dynamic").

Initial state, images and loss are the same as for other methods. As published, `truncated` makes an optimiser step at
each frame with the gradient through the substeps since the previous frame, whose state is detached. The alternative is
one step for the whole video with the gradient through all substeps.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from statistics import median

import torch
from torch import Tensor

from neuma_lib.config.training import TrainingConfig
from neuma_lib.errors import NonFiniteError
from neuma_lib.fitting.material import PixelLoss, weighted_mean
from neuma_lib.fitting.training_loop import TrainingLoop
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.methods.spring_gaus.body import SpringBody
from neuma_lib.methods.spring_gaus.network import Springs
from neuma_lib.methods.spring_gaus.options import SpringsConfig
from neuma_lib.methods.spring_gaus.rollout import SpringModel, spring_rollout
from neuma_lib.sim.state import State


@dataclass
class SpringHistory:
    """Training curves with one entry per iteration, before its optimiser steps."""

    loss: list[float] = field(default_factory=list)  # mean squared error over all frames
    modulus: list[float] = field(default_factory=list)  # Young's modulus of the network [Pa]
    softness: list[float] = field(default_factory=list)  # parameter of the soft vector
    # friction, resistance, gap: see `Springs.values`
    friction: list[float] = field(default_factory=list)
    resistance: list[float] = field(default_factory=list)
    gap: list[float] = field(default_factory=list)
    substeps: list[int] = field(default_factory=list)  # substeps per time step
    lr_scale: list[float] = field(default_factory=list)  # factor on the learning rate after recoveries
    recoveries: list[dict] = field(default_factory=list)  # returns to the best state
    seconds: list[float] = field(default_factory=list)  # wall time [s]


@dataclass
class FittedSprings:
    """Result of `fit_springs`: the springs at the lowest loss, and the training curves."""

    springs: Springs
    substeps: int
    history: SpringHistory
    best_loss: float
    best_iteration: int
    stable: bool

    def summary(self, density: float) -> str:
        """Summary line for the log, for a density [kg/m^3]."""
        if not self.history.loss:
            return f"nothing fitted, loss {self.best_loss:.3e}"
        note = "" if self.stable else "; UNSTABLE, best state kept"
        _, friction, gap = self.springs.shared()
        return (
            f"loss {self.history.loss[0]:.3e} -> {self.best_loss:.3e} at iteration {self.best_iteration}, E "
            f"{self.history.modulus[0]:.3g} -> {self.springs.modulus(density):.3g} Pa, friction {friction:.2f}, "
            f"gap {1e3 * gap:.1f} mm, {self.substeps} substeps, {median(self.history.seconds):.3g} s/iteration{note}"
        )


def fit_springs(
    model: SpringModel,
    body: SpringBody,
    springs: Springs,
    start: State,
    loss: PixelLoss,
    settings: TrainingConfig,
    options: SpringsConfig,
    *,
    checkpoint: Checkpoint | None = None,
    progress: Callable[[int, int, float], None] | None = None,
    log: Callable[[str], None] = print,
) -> FittedSprings:
    """Optimise the parameters of the springs so that the particles match the video.

    Args:
        springs: the network with its parameters, which are optimised in place.
        start: particles with their initial motion.
        loss: loss of the states of the particles at the frames.
        settings: iterations, schedule of learning rates, clipping, frame weights, recoveries.
        options: mode, learning rate, and trainable parameters.
        checkpoint: file for the state of the loop, so that an interrupted run can resume; None for none.
        progress: called with (iteration, iterations, loss).
        log: receives a line for every halving of the substep and every recovery.

    Raises:
        NonFiniteError: the first rollout diverges.
    """
    loop = _Loop(model, body, springs, start, loss, settings, options, log)
    loop.run(checkpoint, progress)
    best = loop.best
    springs.load_state_dict(best["springs"])
    return FittedSprings(
        springs, best["substeps"], loop.history, best["loss"], best["iteration"], stable=not loop.ended
    )


class _Loop(TrainingLoop):
    """State of the fit, and one pass over the video."""

    NAME = "springs"

    def __init__(self, model, body, springs, start, loss, settings, options, log):
        self.model, self.body, self.springs, self.loss = model, body, springs, loss
        self.settings, self.options, self.log = settings, options, log
        self.start = body.start(start)
        self.density = float(start.mass.sum() / start.vol0.sum())
        later = [k for k, n in enumerate(loss.frames) if n > 0]
        self.single = [loss.select([k]) for k in later] if options.truncated else []
        springs.log_damping.requires_grad_(options.learn_resistance)
        springs.gap.requires_grad_(options.learn_gap)
        rates = {"log_damping": 0.1 * options.lr_springs, "gap": 0.03 * options.lr_springs}
        self.model_parts = {"springs": springs}
        self.optimizer = self._adam(
            (p, rate)
            for name, p in springs.named_parameters()
            if p.requires_grad and (rate := rates.get(name, options.lr_springs))
        )
        self._begin(SpringHistory())

    def advance(self) -> None:
        """Evaluate the springs and make one pass of optimiser steps, or return to the best state."""
        started = time.perf_counter()
        try:
            with torch.set_grad_enabled(not self.options.truncated):
                losses = self._frame_losses()
            value = float(losses.detach().mean())
            self.best = self._better_state(value)
            self._record(value)
            self.first_loss = self.first_loss or max(value, 1e-30)
            self._set_rates(self.iteration, self.settings.iterations)
            if self.options.truncated:
                self._frame_by_frame()
            else:
                self._step(weighted_mean(losses, self.iteration, self.settings))
        except NonFiniteError as error:
            self._recover(error)
        else:
            self.history.seconds.append(time.perf_counter() - started)
            self.iteration += 1

    def _mean_loss(self) -> float:
        return float(self._frame_losses().mean())

    def _frame_losses(self) -> Tensor:
        """Losses of all frames, shape (T,)."""
        x, v, self.model = spring_rollout(
            self.model, self.springs, *self.start, self.loss.steps, log=self.log
        )
        return self.loss(self.body.path(self.loss.steps, x, v))

    def _frame_by_frame(self) -> None:
        """An optimiser step for every frame with the gradient through the substeps since the previous state.

        That is the last state of the previous frame, or an earlier one if exposures overlap.
        """
        states = [(0, *self.start)]
        for loss in self.single:
            first, x, v = next(state for state in reversed(states) if state[0] <= loss.steps[0])
            xs, vs, self.model = spring_rollout(
                self.model, self.springs, x, v, loss.steps, first, log=self.log
            )
            self._step(loss(self.body.path(loss.steps, xs, vs)).sum())
            states += zip(loss.steps, xs.detach(), vs.detach(), strict=True)

    def _step(self, loss: Tensor) -> None:
        """One optimiser step on a loss divided by the first one, with clipped gradients."""
        self.optimizer.zero_grad(set_to_none=True)
        (loss / self.first_loss).backward()
        parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        self._clip_gradients(parameters, "the")
        self.optimizer.step()

    def _record(self, value: float) -> None:
        history = self.history
        history.loss.append(value)
        history.modulus.append(self.springs.modulus(self.density))
        history.softness.append(float(self.springs.softness.detach()))
        resistance, friction, gap = self.springs.shared()
        history.resistance.append(resistance)
        history.friction.append(friction)
        history.gap.append(gap)
        history.substeps.append(self.model.substeps)
        history.lr_scale.append(self.lr_scale)

    def _snapshot(self) -> dict:
        return {**super()._snapshot(), "substeps": self.model.substeps}

    def _restore(self, state: dict) -> None:
        super()._restore(state)
        self.model = replace(self.model, substeps=state["substeps"])
