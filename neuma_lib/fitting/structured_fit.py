"""Fit of a structured law around constants that are found already: which parts to correct, and the correction.

A video need not tell anything that the constants leave open. So all parts are first trained together for a few
iterations, without some of the frames. By these every choice of parts (elastic, plastic, both) is judged, with the
other part as it was, beside the law as it is. A part is corrected only if those frames gain enough; the parts that are
chosen are trained on from there, on all frames. The others stay as they are, exactly, and so does a law that nothing
improves. Frames before the first contact say nothing of the law: they train and judge nothing, and the steps up to
there are simulated once, with the law as it is.

A correction bends what its base has: an elastic base never flows, and one that flows at any stress holds no load. Where
constants alone do not tell such families apart, rivals are tried likewise, and the frames judge their corrections, too.

How firmly the correction is held where the video is silent (`neuma_lib.fitting.deviation`) is chosen by the same
frames: of the weights that are tried, the largest that they do as well with.
"""

from __future__ import annotations

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
from neuma_lib.fitting.material import History, Stretch, TrainedMaterial, TrajectoryLoss, train_material
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.mechanics.structured import StructuredLaw
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State, Trajectory

Video = tuple[State, TrajectoryLoss]
LawState = dict[str, Tensor]
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
        base: which of the laws is corrected: 0, or k for the k-th rival.
        trials: what was tried, by the names of the parts joined with " + ", beside `NOTHING`; with a penalty, that too.
            Those of the k-th rival are prefixed with "rival k: ".
        held_out_frames: steps of the frames that judged, a tuple a video.
        penalty: weight of the penalty on states that the video did not visit.
    """

    parts: tuple[str, ...]
    trials: dict[str, Trial]
    held_out_frames: tuple[tuple[int, ...], ...]
    penalty: float = 0.0
    base: int = 0

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON; a loss that is infinite is None."""
        trials = {
            name: {key: value if math.isfinite(value) else None for key, value in found.items()}
            for name, found in _plain(self.trials).items()
        }
        held_out = [list(frames) for frames in self.held_out_frames]
        about = {"corrected_parts": list(self.parts), "base": self.base, "penalty": self.penalty}
        return {**about, "trials": trials, "held_out_frames": held_out}

    def summary(self) -> str:
        """One line for people."""
        before = self.trials[NOTHING].held_out_loss
        gains = [
            f"{name} {100 * (trial.held_out_loss / before - 1):+.1f} %"
            for name, trial in self.trials.items()
            if name != NOTHING
        ]
        chosen = _name(self.base, self.parts)
        held = f", penalty {self.penalty:g}" if self.penalty else ""
        return f"corrected: {chosen}{held}; change of the held-out loss: {', '.join(gains)}"


def train_structured(
    model: MPM,
    law: StructuredLaw,
    start: State,
    loss: TrajectoryLoss,
    settings: TrainingConfig,
    structured: StructuredConfig,
    *,
    rivals: Sequence[StructuredLaw] = (),
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
        rivals: others like it, one of which takes its place if its correction does better on the held-out frames.
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
    laws = [law, *rivals]
    uncorrected = [copy.deepcopy(each.state_dict()) for each in laws]
    as_it_is = [_simulated(model, law, *video) for video in videos]
    if any(found is None for found in as_it_is):
        raise NonFiniteError("material", "the motion of the uncorrected law breaks off")
    paths = [path for path, _ in as_it_is]
    firsts = [
        told_from(len(loss.frames), first_contact(model, path.at(loss.frames).x))
        for (_, loss), path in zip(videos, paths, strict=True)
    ]
    told = [from_frame(*video, path, k) for video, path, k in zip(videos, paths, firsts, strict=True)]
    held_out = [held_out_frames(len(loss.frames), structured.held_out, structured.blocks) for _, loss in told]
    fitted = [
        [k for k in range(len(loss.frames)) if k not in out]
        for (_, loss), out in zip(told, held_out, strict=True)
    ]
    seen = [(start, loss.select(keep)) for keep, (start, loss) in zip(fitted, told, strict=True)]
    brief = settings.model_copy(update={"iterations": structured.trial_iterations})
    first = Stretch(after=settings.iterations)
    weights = [weight for weight in structured.penalties if weight != settings.penalty]
    total = (len(laws) + len(weights)) * brief.iterations + settings.iterations
    kept = checkpoint.load() if checkpoint else None
    trials = {name: Trial(**found) for name, found in kept["trials"].items()} if kept else {}
    states = dict(kept["states"]) if kept else {}

    def train(
        base: int,
        begin: LawState,
        parts: Sequence[str],
        videos: Sequence[Video],
        how: TrainingConfig,
        stretch: Stretch,
        before: int,
    ) -> TrainedMaterial:
        law = laws[base]
        law.load_state_dict(begin)
        for name in trained_parts(law):
            law.parts[PARTS[name]].adaptor.requires_grad_(name in parts)
        inner = checkpoint and _Stage(checkpoint, _plain(trials), dict(states))
        shown = progress and (lambda done, _, value: progress(before + done, total, value))
        options = {"further": videos[1:], "checkpoint": inner, "progress": shown, "log": log}
        return train_material(model, law, *videos[0], how, stretch=stretch, **options)

    def keep(base: int, weight: float, trained: TrainedMaterial) -> LawState:
        found = {"law": copy.deepcopy(trained.law.state_dict()), "memory": trained.memory}
        states[base, weight] = found
        return found["law"]

    def tried(name: str, base: int, state: LawState) -> None:
        """Keep how a law does on the frames that tell of it."""
        laws[base].load_state_dict(state)
        found = [_simulated(model, laws[base], *video) for video in told]
        trials[name] = Trial(math.inf, math.inf)
        if all(found):
            means = (
                _mean(
                    [_mean([losses[k] for k in one]) for (_, losses), one in zip(found, which, strict=True)]
                )
                for which in (fitted, held_out)
            )
            trials[name] = Trial(*means)
        if name != NOTHING:
            log(f"{name} corrected: {_compared(trials[name], trials[NOTHING])}")

    candidates = [(base, parts) for base, law in enumerate(laws) for parts in subsets(trained_parts(law))]
    for base, each in enumerate(laws):
        of_base = [parts for k, parts in candidates if k == base]
        if _name(base, of_base[0]) in trials:
            continue
        done = base * brief.iterations
        trained = train(base, uncorrected[base], trained_parts(each), seen, brief, first, done)
        together = keep(base, settings.penalty, trained)
        if base == 0:
            tried(NOTHING, 0, uncorrected[0])
        for parts in of_base:
            tried(_name(base, parts), base, corrected_in(parts, together, uncorrected[base]))
    base, parts = _chosen(candidates, trials, structured.margin)
    steps = tuple(
        tuple(loss.frames[begin + k] for k in out)
        for begin, out, (_, loss) in zip(firsts, held_out, videos, strict=True)
    )
    choice = Choice(parts, trials, steps, settings.penalty, base)
    if parts:
        name = _name(base, parts)
        losses = {settings.penalty: trials[name].held_out_loss}
        for k, weight in enumerate(weights, len(laws)):
            held = f"{name}, penalty {weight:g}"
            if held not in trials:
                how = brief.model_copy(update={"penalty": weight})
                trained = train(base, uncorrected[base], parts, seen, how, first, k * brief.iterations)
                tried(held, base, keep(base, weight, trained))
            losses[weight] = trials[held].held_out_loss
        choice.penalty = largest_as_good(losses)
        how = settings.model_copy(update={"penalty": choice.penalty})
        found = states[base, choice.penalty]
        begin = corrected_in(parts, found["law"], uncorrected[base])
        last = Stretch(before=brief.iterations, memory=found["memory"])
        return train(base, begin, parts, told, how, last, total - settings.iterations), choice
    law.load_state_dict(uncorrected[0])
    value = _mean([_mean(losses[begin:]) for begin, (_, losses) in zip(firsts, as_it_is, strict=True)])
    return TrainedMaterial(law, History(loss=[value]), value, 0, stable=True), choice


def trained_parts(law: StructuredLaw) -> tuple[str, ...]:
    """Short names of the parts of a law that a correction may change."""
    return tuple(name for name, part in PARTS.items() if part in law.parts)


def rival_bases(identified: Mapping[str, Any], most: int) -> list[dict[str, Any]]:
    """Laws of the families that tie with the identified one and flow otherwise, those of the best scores first.

    What stresses of the same kind of flow differ by, a correction of either can learn.

    Args:
        identified: content of identified.json.
        most: largest number of them.
    """
    kinds = {_flow(identified["law"])}
    tied = sorted((identified["families"][name] for name in identified["ties"]), key=lambda fit: fit["score"])
    found = []
    for law in (fit["law"] for fit in tied):
        if len(found) < most and _flow(law) not in kinds:
            kinds.add(_flow(law))
            found.append(law)
    return found


def subsets(parts: Sequence[str]) -> list[tuple[str, ...]]:
    """All choices of at least one of the parts, smaller ones first."""
    return [chosen for size in range(1, len(parts) + 1) for chosen in combinations(parts, size)]


def corrected_in(parts: Sequence[str], state: LawState, uncorrected: LawState) -> LawState:
    """The state of a law that is corrected in some parts, and in the others as it was."""
    prefixes = tuple(f"{PARTS[name]}." for name in parts)
    return {key: (state if key.startswith(prefixes) else uncorrected)[key] for key in uncorrected}


def told_from(count: int, contact: int) -> int:
    """Index of the first of ``count`` frames that tells of the law: that of the contact, unless too few follow it."""
    return contact if count - contact >= LEAST_FRAMES else 0


def from_frame(start: State, loss: TrajectoryLoss, path: Trajectory, first: int) -> Video:
    """A video from the frame with index ``first`` on; the body starts as it is on a path at the frame before, or
    earlier where what is left shows more.

    Nothing of the law shows before a contact, so those steps are simulated once. Gradients do not reach them.
    """
    if first == 0:
        return start, loss
    left = loss.select(range(first, len(loss.frames)))
    before = [k for k, n in enumerate(path.frames) if n < left.steps[0] and n <= loss.frames[first - 1]]
    if not before:
        return start, left
    at = before[-1]
    state = State(path.x[at], path.v[at], start.mass, start.vol0, path.F[at], path.C[at])
    return state, left.later(path.frames[at])


def _chosen(
    candidates: Iterable[tuple[int, tuple[str, ...]]], trials: dict[str, Trial], margin: float
) -> tuple[int, tuple[str, ...]]:
    """Base and parts of the lowest held-out loss; each part must lower it by the margin, and so must a rival."""

    def score(candidate: tuple[int, tuple[str, ...]]) -> float:
        base, parts = candidate
        return trials[_name(base, parts)].held_out_loss * (1 - margin) ** -(len(parts) + (base > 0))

    return min([(0, ()), *candidates], key=score)


def _name(base: int, parts: Sequence[str]) -> str:
    """Name of the trial of a base's correction."""
    return (f"rival {base}: " if base else "") + (" + ".join(parts) or NOTHING)


def _flow(law: Mapping[str, Any]) -> str:
    """The kind of return map of a law's specification."""
    return law["plasticity"]["name"]


def largest_as_good(losses: dict[float, float]) -> float:
    """The largest weight whose held-out loss is the least one, or exceeds it by no more than `AS_WELL`."""
    return max(w for w, loss in losses.items() if loss <= (1 + AS_WELL) * min(losses.values()))


def _simulated(
    model: MPM, law: StructuredLaw, start: State, loss: TrajectoryLoss
) -> tuple[Trajectory, list[float]] | None:
    """The motion at all steps of a loss, and the losses of its frames; None if it breaks off."""
    with torch.no_grad():
        try:
            path = rollout(model, law, start, steps=loss.steps[-1], frames=loss.steps, total=loss.total)
        except NonFiniteError:
            return None
        return path, loss(path).tolist()


def _plain(trials: dict[str, Trial]) -> dict[str, dict[str, float]]:
    return {name: asdict(trial) for name, trial in trials.items()}


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _compared(trial: Trial, other: Trial) -> str:
    texts = {"fitted": (trial.loss, other.loss), "held out": (trial.held_out_loss, other.held_out_loss)}
    return ", ".join(f"{name} {now:.3e} (before {before:.3e})" for name, (now, before) in texts.items())


@dataclass
class _Stage:
    """The checkpoint of one of several trainings, which also knows what the ones before it found.

    Attributes:
        trials: how what was tried did.
        states: laws that were trained, and the memory of their trainings, by their base and the weight of the penalty.
    """

    whole: Checkpoint
    trials: dict[str, dict[str, float]]
    states: dict[tuple[int, float], dict[str, Any]]

    def load(self) -> dict[str, Any] | None:
        """The state of this training; None if that of another is kept."""
        kept = self.whole.load()
        return kept["loop"] if kept and kept["trials"] == self.trials else None

    def save(self, state: dict[str, Any]) -> None:
        self.whole.save({"trials": self.trials, "states": self.states, "loop": state})
