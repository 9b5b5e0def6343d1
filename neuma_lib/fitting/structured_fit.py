"""Fit of a structured law around constants that are found already: which parts to correct, and the correction.

A video need not tell anything that the constants leave open. So each choice of parts (elastic, plastic, both) is tried:
it is trained for a few iterations without some of the frames, and judged by these, beside the law as it is. A part is
corrected only if those frames gain enough; the parts that are chosen are trained anew, on all frames. The others stay
as they are, exactly, and so does a law that nothing improves. Frames before the first contact say nothing of the law
and judge nothing.

How firmly the correction is held where the video is silent (`neuma_lib.fitting.deviation`) is chosen by the same
frames: of the weights that are tried, the largest that they do as well with.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from neuma_lib.config.material import MaterialConfig
from neuma_lib.config.structured import StructuredConfig
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.frame_batches import first_contact, held_out_frames
from neuma_lib.fitting.material import History, TrainedMaterial, TrajectoryLoss, train_material
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.mechanics.structured import StructuredLaw
from neuma_lib.sim.model import MPMModel
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State, Trajectory

Video = tuple[State, TrajectoryLoss]
NOTHING = "nothing"
"""Name of the choice to correct no part."""
PARTS = {"elastic": "elasticity", "plastic": "plasticity"}
"""Parts of a law by their short names."""
AS_WELL = 0.01
"""Part by which the held-out loss may exceed the least one, for a larger weight of the penalty."""
LEAST_FRAMES = 4
"""Fewer frames cannot be fitted and judged by."""


@dataclass
class Trial:
    """How a choice of parts did.

    Attributes:
        loss: mean loss of the frames that it was trained on.
        held_out_loss: mean loss of the others; infinite if the motion breaks off.
    """

    loss: float
    held_out_loss: float


@dataclass
class Choice:
    """Which parts are corrected, and why.

    Attributes:
        parts: short names of the parts; empty if the law stays as it is.
        trials: what was tried, by the names of the parts joined with " + ", beside `NOTHING`; with a penalty, that too.
        held_out_frames: steps of the frames that judged, a tuple a video.
        penalty: weight of the penalty on states that the video did not visit.
    """

    parts: tuple[str, ...]
    trials: dict[str, Trial]
    held_out_frames: tuple[tuple[int, ...], ...]
    penalty: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON; a loss that is infinite is None."""
        trials = {
            name: {key: value if math.isfinite(value) else None for key, value in asdict(trial).items()}
            for name, trial in self.trials.items()
        }
        held_out = [list(frames) for frames in self.held_out_frames]
        about = {"corrected_parts": list(self.parts), "penalty": self.penalty}
        return {**about, "trials": trials, "held_out_frames": held_out}

    def summary(self) -> str:
        """One line for people."""
        before = self.trials[NOTHING].held_out_loss
        gains = [
            f"{name} {100 * (trial.held_out_loss / before - 1):+.1f} %"
            for name, trial in self.trials.items()
            if name != NOTHING
        ]
        chosen = " + ".join(self.parts) or NOTHING
        held = f", penalty {self.penalty:g}" if self.penalty else ""
        return f"corrected: {chosen}{held}; change of the held-out loss: {', '.join(gains)}"


def train_structured(
    model: MPMModel,
    law: StructuredLaw,
    start: State,
    loss: TrajectoryLoss,
    settings: MaterialConfig,
    structured: StructuredConfig,
    *,
    further: Sequence[Video] = (),
    checkpoint: Checkpoint | None = None,
    progress: Callable[[int, int, float], None] | None = None,
    log: Callable[[str], None] = print,
) -> tuple[TrainedMaterial, Choice]:
    """Choose the parts of a law that deserve a correction, and train them; in place.

    Args:
        model, start, loss, settings, further: as of `train_material`.
        law: analytic law with an adaptor that is zero still.
        structured: how parts are judged.
        checkpoint: keeps what was tried, and the state of the training that runs.
        progress: called with (iterations done, of all trainings together, loss).
        log: receives a line for every trial.

    Raises:
        InputError: too few frames, and as `train_material`.
        NonFiniteError: the law without correction breaks off.
    """
    videos = [(start, loss), *further]
    if any(len(loss.frames) < LEAST_FRAMES for _, loss in videos):
        raise InputError(f"a structured law needs at least {LEAST_FRAMES} frames, to fit and to judge by")
    uncorrected = copy.deepcopy(law.state_dict())
    as_it_is = [_simulated(model, law, *video) for video in videos]
    if any(found is None for found in as_it_is):
        raise NonFiniteError("material", "the motion of the uncorrected law breaks off")
    held_out = [
        held_out_frames(
            len(loss.frames), structured.held_out, structured.blocks, first_contact(model, path.x)
        )
        for (_, loss), (path, _) in zip(videos, as_it_is, strict=True)
    ]
    fitted = [
        [k for k in range(len(loss.frames)) if k not in out]
        for (_, loss), out in zip(videos, held_out, strict=True)
    ]
    seen = [(start, loss.select(keep)) for keep, (start, loss) in zip(fitted, videos, strict=True)]
    trained_parts = [name for name, part in PARTS.items() if part in law.parts]
    choices = [(part,) for part in trained_parts]
    choices += [tuple(trained_parts)] if len(trained_parts) > 1 else []
    brief = settings.model_copy(update={"iterations": structured.trial_iterations})
    kept = checkpoint.load() if checkpoint else None
    trials = {name: Trial(**found) for name, found in kept["trials"].items()} if kept else {}
    weights = [weight for weight in structured.penalties if weight != settings.penalty]
    total = (len(choices) + len(weights)) * brief.iterations + settings.iterations

    def train(parts: Iterable[str], videos: Sequence[Video], how: MaterialConfig, before: int):
        law.load_state_dict(uncorrected)
        for name in trained_parts:
            law.parts[PARTS[name]].adaptor.requires_grad_(name in parts)
        inner = checkpoint and _Stage(checkpoint, {name: asdict(trial) for name, trial in trials.items()})
        shown = progress and (lambda done, _, value: progress(before + done, total, value))
        options = {"further": videos[1:], "checkpoint": inner, "progress": shown, "log": log}
        return train_material(model, law, *videos[0], how, **options)

    def judged_by(videos: Sequence[tuple[Trajectory, list[float]] | None]) -> Trial:
        if any(found is None for found in videos):
            return Trial(math.inf, math.inf)
        losses = [found for _, found in videos]
        parts = (
            [_mean([found[k] for k in one]) for found, one in zip(losses, which, strict=True)]
            for which in (fitted, held_out)
        )
        return Trial(*map(_mean, parts))

    def tried() -> Trial:
        return judged_by([_simulated(model, law, *video) for video in videos])

    trials[NOTHING] = judged_by(as_it_is)
    for k, parts in enumerate(choices):
        name = " + ".join(parts)
        if name not in trials:
            train(parts, seen, brief, k * brief.iterations)
            trials[name] = tried()
            log(f"{name} corrected: {_compared(trials[name], trials[NOTHING])}")
    parts = _chosen(choices, trials, structured.margin)
    steps = (tuple(loss.frames[k] for k in out) for out, (_, loss) in zip(held_out, videos, strict=True))
    choice = Choice(parts, trials, tuple(steps), settings.penalty)
    if parts:
        name = " + ".join(parts)
        judged = {settings.penalty: trials[name].held_out_loss}
        for k, weight in enumerate(weights, len(choices)):
            held = f"{name}, penalty {weight:g}"
            if held not in trials:
                train(parts, seen, brief.model_copy(update={"penalty": weight}), k * brief.iterations)
                trials[held] = tried()
                log(f"{held}: {_compared(trials[held], trials[NOTHING])}")
            judged[weight] = trials[held].held_out_loss
        choice.penalty = largest_as_good(judged)
        how = settings.model_copy(update={"penalty": choice.penalty})
        return train(parts, videos, how, total - settings.iterations), choice
    law.load_state_dict(uncorrected)
    value = _mean([_mean(losses) for _, losses in as_it_is])
    return TrainedMaterial(law, History(loss=[value]), value, 0, stable=True), choice


def _chosen(choices: Iterable[tuple[str, ...]], trials: dict[str, Trial], margin: float) -> tuple[str, ...]:
    """Parts of the lowest held-out loss, of which each must lower it by the margin."""

    def score(parts: tuple[str, ...]) -> float:
        loss = trials[" + ".join(parts) or NOTHING].held_out_loss
        return loss * (1 - margin) ** -len(parts)

    return min([(), *choices], key=score)


def largest_as_good(losses: dict[float, float]) -> float:
    """The largest weight whose held-out loss is the least one, or exceeds it by no more than `AS_WELL`."""
    return max(w for w, loss in losses.items() if loss <= (1 + AS_WELL) * min(losses.values()))


def _simulated(
    model: MPMModel, law: StructuredLaw, start: State, loss: TrajectoryLoss
) -> tuple[Trajectory, list[float]] | None:
    """The motion at all frames, and their losses; None if it breaks off."""
    frames = loss.frames
    with torch.no_grad():
        try:
            path = rollout(model, law, start, steps=frames[-1], frames=frames, total=loss.total)
        except NonFiniteError:
            return None
        return path, loss(path).tolist()


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _compared(trial: Trial, other: Trial) -> str:
    texts = {"fitted": (trial.loss, other.loss), "held out": (trial.held_out_loss, other.held_out_loss)}
    return ", ".join(f"{name} {now:.3e} (before {before:.3e})" for name, (now, before) in texts.items())


@dataclass
class _Stage:
    """The checkpoint of one of several trainings, which also knows what was tried before it."""

    whole: Checkpoint
    trials: dict[str, dict[str, float]]

    def load(self) -> dict[str, Any] | None:
        """The state of this training; None if that of another is kept."""
        kept = self.whole.load()
        return kept["loop"] if kept and kept["trials"] == self.trials else None

    def save(self, state: dict[str, Any]) -> None:
        self.whole.save({"trials": self.trials, "loop": state})
