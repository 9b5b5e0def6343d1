"""Common base of training loops: Adam with a schedule, recovery from divergence, and checkpoints."""

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from typing import Any, ClassVar

import torch
from torch.optim import Optimizer

from neuma_lib.config.training import TrainingConfig
from neuma_lib.errors import NonFiniteError
from neuma_lib.io.checkpoint import Checkpoint


class TrainingLoop(ABC):
    """A training loop that returns to its best state if a step diverges.

    Attributes:
        settings: maximum number of recoveries, among others.
        log: receives a line for every recovery.
        optimizer: the optimizer.
        model_parts: modules by their names in checkpoints, the fitted law or network.
        iteration: number of accepted steps.
        lr_scale: factor on the learning rates after recoveries.
        ended: whether the loop stopped after too many recoveries.
        history: training curves, a dataclass with a list ``recoveries``.
        first_loss: unit of the loss, None before the first one.
        best: state of the lowest loss, with ``loss`` and ``iteration``.
    """

    NAME: ClassVar[str]
    """Name of the loop in errors."""

    settings: TrainingConfig
    log: Callable[[str], None]
    optimizer: Optimizer
    model_parts: dict[str, torch.nn.Module]

    def _adam(self, groups: Iterable[tuple[Any, float]]) -> Optimizer:
        """Adam for pairs of parameters and their learning rates."""
        groups = [{"params": p, "lr": rate, "base_lr": rate} for p, rate in groups]
        return torch.optim.Adam(groups, betas=self.settings.betas)

    def _begin(self, history: Any, first_loss: float | None = None) -> None:
        """Initialise the loop at the end of construction, with the current state as the best one."""
        self.iteration, self.lr_scale, self.ended = 0, 1.0, False
        self.history, self.first_loss = history, first_loss
        self.best = {"loss": math.inf, "iteration": 0, **self._snapshot()}

    def run(
        self, checkpoint: Checkpoint | None = None, progress: Callable[[int, int, float], None] | None = None
    ) -> None:
        """Advance to the last iteration.

        Args:
            checkpoint: file for the state, so that an interrupted run can resume; None for none.
            progress: called with (iteration, iterations, loss).
        """
        settings = self.settings
        if checkpoint is not None and (state := checkpoint.load()) is not None:
            self.load_state_dict(state)
            self.log(f"resumed at iteration {self.iteration} of {settings.iterations}")
        while self.iteration < settings.iterations and not self.ended:
            self.advance()
            if progress:
                progress(self.iteration, settings.iterations, self.history.loss[-1])
            if checkpoint is not None and self.iteration % settings.checkpoint_every == 0:
                checkpoint.save(self.state_dict())
        self._update_best()

    @abstractmethod
    def advance(self) -> None:
        """One accepted optimiser step, or a return to the best state."""

    def _set_rates(self, iteration: int, iterations: int, factor: float = 1.0) -> None:
        """Learning rates of an iteration: a cosine from 1 to ``lr_floor``, times a factor and that of recoveries."""
        floor = self.settings.lr_floor
        cosine = (1 + math.cos(math.pi * iteration / max(1, iterations))) / 2
        schedule = factor * (floor + (1 - floor) * cosine)
        for group in self.optimizer.param_groups:
            group["lr"] = group["base_lr"] * self.lr_scale * schedule

    def _clip_gradients(self, parameters: list[torch.nn.Parameter], name: str) -> float:
        """Clip the gradients and return their norm. Raises NonFiniteError."""
        norm = float(torch.nn.utils.clip_grad_norm_(parameters, self.settings.gradient_clip))
        if not math.isfinite(norm):
            raise NonFiniteError(self.NAME, f"{name} gradient is not finite at iteration {self.iteration}")
        return norm

    @abstractmethod
    def _mean_loss(self) -> float:
        """The loss of the current state."""

    def _update_best(self) -> None:
        """Update the best state after the last optimiser step."""
        if self.ended:
            return
        try:
            with torch.no_grad():
                self.best = self._better_state(self._mean_loss())
        except NonFiniteError:
            return

    def _snapshot(self) -> dict[str, Any]:
        """Copies of all values that an optimiser step changes or depends on."""
        parts = {**self.model_parts, "optimizer": self.optimizer}
        return {name: copy.deepcopy(part.state_dict()) for name, part in parts.items()}

    def _restore(self, state: dict[str, Any]) -> None:
        """Return to a `_snapshot` without changing it."""
        for name, module in self.model_parts.items():
            module.load_state_dict(state[name])
        self.optimizer.load_state_dict(copy.deepcopy(state["optimizer"]))

    def _better_state(self, value: float) -> dict[str, Any]:
        """The current state if its loss is the lowest so far, else the best one."""
        if value < self.best["loss"]:
            return {"loss": value, "iteration": self.iteration, **self._snapshot()}
        return self.best

    def _recover(self, error: NonFiniteError) -> None:
        """Return to the best state with half the learning rates, or end the loop after too many recoveries.

        The state before the diverging step is not used because its loss may already be far above the best one. The
        schedule of learning rates continues, so the number of iterations stays bounded.
        """
        if not math.isfinite(self.best["loss"]):
            raise error
        self.lr_scale /= 2
        self._restore(self.best)
        entry = {"iteration": self.iteration, "reason": str(error), "lr_scale": self.lr_scale}
        self.history.recoveries.append(entry)
        self.log(
            f"iteration {self.iteration}: {error}; back to the best state, that of iteration "
            f"{self.best['iteration']}, rates x{self.lr_scale:g}"
        )
        self.ended = len(self.history.recoveries) > self.settings.max_recoveries

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next iterations depend on."""
        return {
            **{key: getattr(self, key) for key in ("iteration", "lr_scale", "ended", "first_loss")},
            "history": copy.deepcopy(self.history.__dict__),
            "best": copy.deepcopy(self.best),
            **self._snapshot(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict`."""
        for key in ("iteration", "lr_scale", "ended", "first_loss", "best"):
            setattr(self, key, state[key])
        self.history = type(self.history)(**state["history"])
        self._restore(state)
