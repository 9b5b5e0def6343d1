"""What loops of optimiser steps have in common: a best state that they return to, and a state on disk."""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from torch.optim import Optimizer

from neuma_lib.config.training import TrainingConfig
from neuma_lib.errors import NonFiniteError
from neuma_lib.io.checkpoint import Checkpoint


class TrainingLoop(ABC):
    """State of a loop: best so far, factor on the learning rates, curves.

    Attributes:
        settings: how many recoveries are allowed, among others.
        log: receives a line for every recovery.
        optimizer: whose steps the loop makes.
        iteration: accepted steps.
        lr_scale: factor on the learning rates after recoveries.
        ended: too many recoveries, the loop stops at its best state.
        history: curves, a dataclass with a list ``recoveries``.
        first_loss: what losses are measured by; None: no loss yet.
        best: the state of lowest loss, with ``loss`` and ``iteration``.
    """

    RETURN: ClassVar[str] = "back to the best state, that of iteration"

    settings: TrainingConfig
    log: Callable[[str], None]
    optimizer: Optimizer

    def _begin(self, history: Any, first_loss: float | None = None) -> None:
        """The end of a construction: the state that the loop starts from is its best one."""
        self.iteration, self.lr_scale, self.ended = 0, 1.0, False
        self.history, self.first_loss = history, first_loss
        self.best = {"loss": math.inf, "iteration": 0, **self._snapshot()}

    def run(
        self, checkpoint: Checkpoint | None = None, progress: Callable[[int, int, float], None] | None = None
    ) -> None:
        """Advance to the last iteration.

        Args:
            checkpoint: where to keep the state, so that a killed run goes on; None keeps none.
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
        self._judge_last_step()

    @abstractmethod
    def advance(self) -> None:
        """One accepted optimiser step, or a return to the best state."""

    @abstractmethod
    def _mean_loss(self) -> float:
        """The loss of the present state."""

    def _judge_last_step(self) -> None:
        """Whether the state after the last optimiser step is the best one."""
        if self.ended:
            return
        try:
            with torch.no_grad():
                self.best = self._better_state(self._mean_loss())
        except NonFiniteError:
            return

    @abstractmethod
    def _snapshot(self) -> dict[str, Any]:
        """Copies of what an optimiser step changes or depends on."""

    @abstractmethod
    def _restore(self, state: dict[str, Any]) -> None:
        """Return to a `_snapshot`, which stays as it is."""

    def _better_state(self, value: float) -> dict[str, Any]:
        """The present state if its loss is the lowest so far, else the best one."""
        if value < self.best["loss"]:
            return {"loss": value, "iteration": self.iteration, **self._snapshot()}
        return self.best

    def _recover(self, error: NonFiniteError) -> None:
        """Return to the best state as a whole with half the learning rates; after too many returns the loop ends there.

        Not to the state before the diverging step: its loss may already be far above the best one. The schedule of
        rates goes on, so the number of iterations stays bounded.
        """
        if not math.isfinite(self.best["loss"]):
            raise error
        self.lr_scale /= 2
        self._restore(self.best)
        entry = {"iteration": self.iteration, "reason": str(error), "lr_scale": self.lr_scale}
        self.history.recoveries.append(entry)
        self.log(
            f"iteration {self.iteration}: {error}; {self.RETURN} {self.best['iteration']}, rates x{self.lr_scale:g}"
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
