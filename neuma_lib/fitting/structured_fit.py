"""Fit of a structured law with identified constants: selection of the parts to correct, and their correction.

A video may not contain information beyond the constants. All parts are therefore first trained together for a few
iterations without the held-out frames. The held-out loss of every choice of parts (elastic, plastic, both) is compared
with that of the uncorrected law, and a part is corrected only if it decreases by a margin. Training of the selected
parts continues on all frames. Other parts remain exactly unchanged. Frames before the first contact do not depend on
the law. They are excluded, and the steps up to the contact are simulated once with the uncorrected law.

A correction cannot change the kind of its base: an elastic base never flows, and a fluid base carries no static load.
If the constants alone do not distinguish such families, corrections of rivals are compared in the same way.
"""

import copy
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any

import torch
from torch import Tensor

from neuma_lib.config.structured import StructuredConfig
from neuma_lib.config.training import TrainingConfig
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.frame_batches import first_contact, held_out_frames
from neuma_lib.fitting.material import (
    History,
    Stretch,
    Surrounded,
    TrainedMaterial,
    TrajectoryLoss,
    alone,
    train_material,
)
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.structured import StructuredLaw
from neuma_lib.sim.model import MPM, MaterialRegion
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State, Trajectory

Video = tuple[State, TrajectoryLoss]
LawState = dict[str, Tensor]
NOTHING = "nothing"
"""Name of the selection without parts."""
PARTS = {"elastic": "elasticity", "plastic": "plasticity"}
"""Parts of a law by their short names."""
MIN_FRAMES = 4
"""Minimum number of frames for fit and evaluation."""


@dataclass(frozen=True)
class Alternative:
    """A law that may be corrected in place of the first one.

    Attributes:
        law: analytic law with an adaptor that is zero.
        name: prefix of its trials.
        surrounded: as in `train_material`.
        rival: whether it also replaces an identified law, so that the held-out loss must decrease by another margin.
            False for the law of another body.
    """

    law: StructuredLaw
    name: str
    surrounded: Surrounded = alone
    rival: bool = True


@dataclass
class Score:
    """Losses of a choice of parts.

    Attributes:
        loss: mean loss of the training frames.
        held_out_loss: mean loss of the held-out frames, infinite if the simulation diverges.
    """

    loss: float
    held_out_loss: float


@dataclass
class Selection:
    """Selected parts and the scores of all choices.

    Attributes:
        parts: short names of the corrected parts, empty if the law is unchanged.
        trials: scores by names of the parts joined with " + ", after the name of the law if it has one, and of
            `NOTHING`.
        held_out_frames: steps of the held-out frames, one tuple per video.
        base: index of the corrected law: 0, or k for the k-th alternative.
        name: name of the corrected law.
    """

    parts: tuple[str, ...]
    trials: dict[str, Score]
    held_out_frames: tuple[tuple[int, ...], ...]
    base: int = 0
    name: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON, with None for an infinite loss."""
        trials = {
            name: {key: value if math.isfinite(value) else None for key, value in losses.items()}
            for name, losses in _plain(self.trials).items()
        }
        held_out = [list(frames) for frames in self.held_out_frames]
        about = {"corrected_parts": list(self.parts), "base": self.base, "name": self.name}
        return {**about, "trials": trials, "held_out_frames": held_out}

    def summary(self) -> str:
        """Summary line for the log."""
        before = self.trials[NOTHING].held_out_loss
        changes = [
            f"{name} {100 * (score.held_out_loss / before - 1):+.1f} %"
            for name, score in self.trials.items()
            if name != NOTHING
        ]
        return f"corrected: {_name(self.name, self.parts)}; change of the held-out loss: {', '.join(changes)}"


def train_structured(
    model: MPM,
    law: StructuredLaw,
    start: State,
    loss: TrajectoryLoss,
    settings: TrainingConfig,
    structured: StructuredConfig,
    *,
    alternatives: Sequence[Alternative] = (),
    other_videos: Sequence[Video] = (),
    checkpoint: Checkpoint | None = None,
    progress: Callable[[int, int, float], None] | None = None,
    log: Callable[[str], None] = print,
    surrounded: Surrounded = alone,
    name: str = "",
) -> tuple[TrainedMaterial, Selection]:
    """Select the parts of a law to correct, and train them in place.

    Args:
        model, start, loss, settings, other_videos, surrounded: as in `train_material`.
        law: analytic law with an adaptor that is zero.
        structured: settings of the selection.
        alternatives: laws of other families or bodies, one of which is corrected if its held-out loss is lower.
        checkpoint: file for finished trials and the state of the running training.
        progress: called with (finished iterations, iterations of all trainings, loss).
        log: receives a line for every trial.
        name: of the law, for several bodies.

    Raises:
        InputError: too few frames, and as `train_material`.
        NonFiniteError: the simulation with the uncorrected law diverges.
    """
    videos = [(start, loss), *other_videos]
    if (count := min(len(loss.frames) for _, loss in videos)) < MIN_FRAMES:
        problem = f"{count} must be at least {MIN_FRAMES}, to fit and to evaluate a structured law"
        raise InputError("frames", problem)
    bases = [Alternative(law, name, surrounded, rival=False), *alternatives]
    uncorrected = [copy.deepcopy(each.law.state_dict()) for each in bases]
    simulated = [_simulate(model, surrounded(law), *video) for video in videos]
    if any(result is None for result in simulated):
        raise NonFiniteError("material", "the simulation with the uncorrected law diverges")
    paths = [path for path, _ in simulated]
    firsts = [  # a simulation that starts later would have moving obstacles at other times
        0
        if model.changes or own.bodies  # several may touch each other before the obstacles
        else first_informative_frame(
            len(loss.frames), first_contact(model, path.at(loss.frames).x, own.vol0, loss.frames)
        )
        for (own, loss), path in zip(videos, paths, strict=True)
    ]
    informative = [from_frame(*video, path, k) for video, path, k in zip(videos, paths, firsts, strict=True)]
    held_out = [
        held_out_frames(len(loss.frames), structured.held_out, structured.blocks) for _, loss in informative
    ]
    fitted = [
        [k for k in range(len(loss.frames)) if k not in out]
        for (_, loss), out in zip(informative, held_out, strict=True)
    ]
    training = [(start, loss.select(keep)) for keep, (start, loss) in zip(fitted, informative, strict=True)]
    brief = settings.model_copy(update={"iterations": structured.trial_iterations})
    first = Stretch(after=settings.iterations)
    total = len(bases) * brief.iterations + settings.iterations
    saved = checkpoint.load() if checkpoint else None
    trials = {name: Score(**losses) for name, losses in saved["trials"].items()} if saved else {}
    states = dict(saved["states"]) if saved else {}

    def train(
        base: int,
        begin: LawState,
        parts: Sequence[str],
        videos: Sequence[Video],
        settings: TrainingConfig,
        stretch: Stretch,
        before: int,
    ) -> TrainedMaterial:
        law = bases[base].law
        law.load_state_dict(begin)
        for name in trained_parts(law):
            law.parts[PARTS[name]].adaptor.requires_grad_(name in parts)
        inner = checkpoint and _Stage(checkpoint, _plain(trials), dict(states))
        overall = progress and (lambda done, _, value: progress(before + done, total, value))
        options = {"other_videos": videos[1:], "checkpoint": inner, "progress": overall, "log": log}
        options["surrounded"] = bases[base].surrounded
        return train_material(model, law, *videos[0], settings, stretch=stretch, **options)

    def evaluate(name: str, base: int, state: LawState) -> None:
        """Store the score of a law on the informative frames."""
        bases[base].law.load_state_dict(state)
        law = bases[base].surrounded(bases[base].law)
        results = [_simulate(model, law, *video) for video in informative]
        trials[name] = Score(math.inf, math.inf)
        if all(results):
            means = (
                _mean(
                    [_mean([losses[k] for k in one]) for (_, losses), one in zip(results, which, strict=True)]
                )
                for which in (fitted, held_out)
            )
            trials[name] = Score(*means)
        if name != NOTHING:
            log(f"{name} corrected: {_compared(trials[name], trials[NOTHING])}")

    candidates = [(k, parts) for k, each in enumerate(bases) for parts in subsets(trained_parts(each.law))]
    for base, each in enumerate(bases):
        of_base = [parts for k, parts in candidates if k == base]
        if _name(each.name, of_base[0]) in trials:
            continue
        done = base * brief.iterations
        trained = train(base, uncorrected[base], of_base[-1], training, brief, first, done)
        states[base] = {"law": copy.deepcopy(trained.law.state_dict()), "memory": trained.memory}
        if base == 0:
            evaluate(NOTHING, 0, uncorrected[0])
        for parts in of_base:
            state = corrected_in(parts, states[base]["law"], uncorrected[base])
            evaluate(_name(each.name, parts), base, state)
    base, parts = _select(candidates, bases, trials, structured.margin)
    steps = tuple(
        tuple(loss.frames[begin + k] for k in out)
        for begin, out, (_, loss) in zip(firsts, held_out, videos, strict=True)
    )
    selection = Selection(parts, trials, steps, base, bases[base].name)
    if parts:
        begin = corrected_in(parts, states[base]["law"], uncorrected[base])
        last = Stretch(before=brief.iterations, memory=states[base]["memory"])
        return train(base, begin, parts, informative, settings, last, total - settings.iterations), selection
    law.load_state_dict(uncorrected[0])
    value = _mean([_mean(losses[begin:]) for begin, (_, losses) in zip(firsts, simulated, strict=True)])
    return TrainedMaterial(law, History(loss=[value]), value, 0, stable=True), selection


def trained_parts(law: StructuredLaw) -> tuple[str, ...]:
    """Short names of the parts of a law that a correction can change."""
    return tuple(name for name, part in PARTS.items() if part in law.parts)


def rival_bases(identified: Mapping[str, Any], limit: int) -> list[dict[str, Any]]:
    """Laws of tied families with other return maps than the identified one, in order of score.

    Families with the same return map are omitted because a correction of one can learn the stress of the other.

    Args:
        identified: content of identified.json.
        limit: maximum number of laws.
    """
    kinds = {_flow(identified["law"])}
    tied = sorted((identified["families"][name] for name in identified["ties"]), key=lambda fit: fit["score"])
    laws = []
    for law in (fit["law"] for fit in tied):
        if len(laws) < limit and _flow(law) not in kinds:
            kinds.add(_flow(law))
            laws.append(law)
    return laws


def subsets(parts: Sequence[str]) -> list[tuple[str, ...]]:
    """All non-empty subsets of the parts, smaller ones first."""
    return [subset for size in range(1, len(parts) + 1) for subset in combinations(parts, size)]


def corrected_in(parts: Sequence[str], state: LawState, uncorrected: LawState) -> LawState:
    """The state of a law that is corrected only in some parts."""
    prefixes = tuple(f"{PARTS[name]}." for name in parts)
    return {key: (state if key.startswith(prefixes) else uncorrected)[key] for key in uncorrected}


def first_informative_frame(count: int, contact: int) -> int:
    """Index of the first of ``count`` frames that depends on the law: that of the contact, unless too few follow it."""
    return contact if count - contact >= MIN_FRAMES else 0


def from_frame(start: State, loss: TrajectoryLoss, path: Trajectory, first: int) -> Video:
    """A video from the frame with index ``first`` on, which starts from the state of a path at the previous frame or
    earlier, before all steps of the remaining exposures.

    The steps before a contact do not depend on the law, so they are simulated once and have no gradient.
    """
    if first == 0:
        return start, loss
    rest = loss.select(range(first, len(loss.frames)))
    before = [k for k, n in enumerate(path.frames) if n < rest.steps[0] and n <= loss.frames[first - 1]]
    if not before:
        return start, rest
    at = before[-1]
    return start.after(path, at), rest.later(path.frames[at])


def _select(
    candidates: Iterable[tuple[int, tuple[str, ...]]],
    bases: Sequence[Alternative],
    trials: dict[str, Score],
    margin: float,
) -> tuple[int, tuple[str, ...]]:
    """Base and parts of the lowest held-out loss. Each part, and a rival, must decrease it by the margin."""

    def weighted(candidate: tuple[int, tuple[str, ...]]) -> float:
        k, parts = candidate
        held_out = trials[_name(bases[k].name, parts)].held_out_loss
        return held_out * (1 - margin) ** -(len(parts) + bases[k].rival)

    return min([(0, ()), *candidates], key=weighted)


def _name(law: str, parts: Sequence[str]) -> str:
    """Name of the trial of a correction."""
    return (f"{law}: " if law and parts else "") + (" + ".join(parts) or NOTHING)


def _flow(law: Mapping[str, Any]) -> str:
    """Name of the return map of a specification."""
    return law["plasticity"]["name"]


def _simulate(
    model: MPM, law: Law | Sequence[MaterialRegion], start: State, loss: TrajectoryLoss
) -> tuple[Trajectory, list[float]] | None:
    """The motion at all steps of a loss, and the losses of its frames; None if it diverges."""
    with torch.no_grad():
        try:
            path = rollout(model, law, start, steps=loss.steps[-1], frames=loss.steps, total=loss.total)
        except NonFiniteError:
            return None
        return path, loss(path).tolist()


def _plain(trials: dict[str, Score]) -> dict[str, dict[str, float]]:
    return {name: asdict(score) for name, score in trials.items()}


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _compared(score: Score, other: Score) -> str:
    losses = {"fitted": (score.loss, other.loss), "held out": (score.held_out_loss, other.held_out_loss)}
    return ", ".join(f"{name} {now:.3e} (before {before:.3e})" for name, (now, before) in losses.items())


@dataclass
class _Stage:
    """Checkpoint of one of several trainings, including the results of the previous ones."""

    whole: Checkpoint
    trials: dict[str, dict[str, float]]  # scores of finished trials
    states: dict[int, dict[str, Any]]  # trained laws and the memory of their trainings by base

    def load(self) -> dict[str, Any] | None:
        """The state of this training, or None if the checkpoint belongs to another."""
        saved = self.whole.load()
        return saved["loop"] if saved and saved["trials"] == self.trials else None

    def save(self, state: dict[str, Any]) -> None:
        self.whole.save({"trials": self.trials, "states": self.states, "loop": state})
