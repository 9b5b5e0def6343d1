"""Rank what could be filmed next with an object whose material has been identified."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.next import NextConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.candidate_experiments import STARTS, as_cameras, draw_starts, second_cameras
from neuma_lib.fitting.families import Family
from neuma_lib.fitting.identified import FamilyFit
from neuma_lib.fitting.next_experiment import (
    Experiment,
    Forecast,
    Knowledge,
    motion_std,
    newly_determined,
    spread,
    stds,
    undetermined,
    unfilmed,
)
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.combinations import Values
from neuma_lib.sim.batch import rollout_batch
from neuma_lib.sim.model import MPM
from neuma_lib.sim.state import Trajectory
from neuma_lib.splatting.observation import joint_frames
from neuma_lib.splatting.viewpoints import video_views

MIN_GAIN = 0.05  # relative decrease of what is ranked below which an experiment is useless
_LENGTHS = ("height", "center", "velocity", "size", "lowest", "highest")  # settings with lengths [m] or [m/s]
_IDENTIFY = "Run `snakemake --cores 2 results/<scene>/identified.json` first"


@dataclass(frozen=True)
class Option:
    """An experiment that could be done next."""

    kind: str  # one of `NextConfig.kinds`
    settings: dict[str, Any]  # of its scene, or of the camera
    forecast: Forecast  # its expected result
    after: float  # what is ranked, after the experiment (`Selection.goal`); smaller is better
    prediction: float | None  # expected standard deviation of the chosen motion [m], or None
    # experiment, path: what would be filmed, and its motion with the identified constants
    experiment: Experiment
    path: Trajectory


@dataclass(frozen=True)
class Selection:
    """Options for the next experiment, the best first."""

    # what is ranked: "prediction", its standard deviation [m]; "constants", the geometric mean of the
    # standard deviations of their logarithms; or "families", the probability of the rival relative to the
    # identified one
    goal: str
    before: float  # it, with what is known
    known: FamilyFit  # the identified family with what is known
    prediction: float | None  # standard deviation of the chosen motion [m] with what is known, or None
    options: list[Option]  # ranked
    failed: int  # number of candidates whose simulation diverged
    settings: IdentifyConfig

    def gain(self, option: Option) -> float:
        """Relative decrease of what is ranked."""
        return 1 - option.after / self.before

    @property
    def useful(self) -> bool:
        """Whether the best option gains at least `MIN_GAIN`."""
        return self.gain(self.options[0]) >= MIN_GAIN

    def as_dict(self, scale: float = 1.0) -> dict[str, Any]:
        """Plain numbers for JSON, with lengths in metres of a room of which one has ``scale`` metres of the box."""
        ranked = scale if self.goal == "prediction" else 1.0
        return {
            "family": self.known.family.name,
            "goal": self.goal,
            "before": self.before / ranked,
            "useful": self.useful,
            "known": stds(self.known, self.settings),
            **({"prediction_std": self.prediction / scale} if self.prediction is not None else {}),
            "failed": self.failed,
            "candidates": [self._option(option, scale) for option in self.options],
        }

    def _option(self, option: Option, scale: float) -> dict[str, Any]:
        fit, settings = option.forecast.fit, self.settings
        return {
            "kind": option.kind,
            "settings": _in_room(option.settings, scale),
            "after": option.after / (scale if self.goal == "prediction" else 1.0),
            "expected": stds(fit, settings),
            "becomes_determined": {
                name: {"before": before, "after": after}
                for name, (before, after) in newly_determined(self.known, fit, settings).items()
            },
            "log_bayes_factors": {
                name: value if math.isfinite(value) else None
                for name, value in option.forecast.evidence.items()
            },
            **({"prediction_std": option.prediction / scale} if option.prediction is not None else {}),
            "covariance": fit.covariance.tolist(),
        }


def _in_room(settings: Mapping[str, Any], scale: float) -> dict[str, Any]:
    """Settings of a scene, with lengths in metres of a room of which one has ``scale`` metres of the box."""
    if scale == 1.0:
        return dict(settings)
    own: dict[str, Any] = {}
    for key, value in settings.items():
        if key in _LENGTHS:
            own[key] = (np.array(value) / scale).tolist()
        elif key == "keyframes":
            own[key] = [[time, (np.array(centre) / scale).tolist(), turn] for time, centre, turn in value]
        else:
            own[key] = [_in_room(each, scale) for each in value] if key in ("colliders", "clamps") else value
    return own


def read_fit(record: Mapping[str, Any], settings: IdentifyConfig) -> FamilyFit:
    """The selected family with constants and covariance, from the content of identified.json.

    Raises:
        InputError: the family is not among the candidates of the settings, or the record is of an older version.
    """
    name, best = record.get("family"), record.get("best", {}).get("unbounded")
    if name not in settings.families or best is None:
        problem = f"family {name!r} is not in identify.families, or has no covariance"
        raise InputError("identified.json", problem, _IDENTIFY)
    family = Family(name, settings.families[name].plain())
    values, covariance = np.array(best["values"]), np.array(best["covariance"])
    loss = record["best"].get("loss", math.inf)
    return FamilyFit(family, family.bounded(values), loss, covariance=covariance)


def read_rivals(
    record: Mapping[str, Any], settings: IdentifyConfig, fit: FamilyFit, count: int
) -> list[tuple[Family, Values]]:
    """The families with the lowest scores that could be the material instead, and their constants.

    Families that contain the selected one are none, since they have the same images.
    """
    scored = [
        (each["score"], name, {key: constant["value"] for key, constant in each["constants"].items()})
        for name, each in record.get("families", {}).items()
        if name != fit.family.name and name in settings.families and "score" in each and "constants" in each
    ]
    rivals = []
    for _, name, values in sorted(scored, key=lambda entry: entry[0]):
        family = Family(name, settings.families[name].plain())
        if not family.contains(fit.family):
            rivals.append((family, family.with_guesses({**values, **fit.values})))
    return rivals[:count]


def choose_next(
    fit: FamilyFit,
    filmed: Sequence[Experiment],
    settings: IdentifyConfig,
    lab: NextConfig,
    *,
    rivals: Sequence[tuple[Family, Values]] = (),
    ties: bool = False,
    derivatives: Tensor | None = None,
    reframe: bool = True,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    log: Callable[[str], None] = lambda text: None,
) -> Selection:
    """Rank candidates for the next experiment.

    Args:
        fit: the identified family with the covariance of its unbounded constants.
        filmed: the experiments in which it was identified. The first one gives body, duration and cameras.
        settings: those of the identification.
        lab: number, kinds and limits of the candidates.
        rivals: other families to distinguish, with constants to start from.
        ties: whether a rival predicts equally well, so that families are still to be distinguished.
        derivatives: of the motion to predict, see `motion_derivatives`, or None.
        reframe: whether the cameras are those of a rendered scene, which are placed so that they see the whole motion.
            They are fixed otherwise.
        progress: called with (finished candidates, their number).
        log: receives a line for each candidate.

    Raises:
        InputError: all constants are determined and nothing else is asked, or no candidate is possible.
        NonFiniteError: a simulation of an existing video, or of all candidates, diverges.
    """
    goal = "prediction" if derivatives is not None else "constants"
    if goal == "constants" and not undetermined(fit, settings):
        goal = "families"
        if not (ties and rivals):
            known = ", ".join(f"{name} {100 * std:.0f} %" for name, std in stds(fit, settings).items())
            raise InputError(
                "next",
                f"all constants are determined already ({known}), and no other family predicts as well",
                "Set next.predict to a motion to predict, or lower identify.determined under advanced",
            )
    known = Knowledge.of_videos(fit, filmed, settings, rivals)
    log(f"noise {known.noise:.3g}, {len(rivals)} rivals")

    def ranked(forecast: Forecast) -> tuple[float, float | None]:
        predicted = None if derivatives is None else motion_std(derivatives, forecast.fit.covariance)
        if goal == "families":
            return math.exp(-min(forecast.evidence.values(), default=0.0)), predicted
        return (spread(forecast.fit, settings) if predicted is None else predicted), predicted

    now = Forecast(fit, np.zeros_like(fit.covariance), {})
    before, prediction = ranked(now)
    candidates = _candidates(filmed[0], known, lab, reframe, seed, log)
    options, failed = [], 0
    for done, (kind, own, experiment, path) in enumerate(candidates):
        try:
            if experiment is None:
                raise NonFiniteError("next", "the simulation diverges")
            forecast = known.forecast(experiment, filmed[0] if kind == "camera" else None)
        except NonFiniteError:
            failed += 1
        else:
            after, predicted = ranked(forecast)
            options.append(Option(kind, own, forecast, after, predicted, experiment, path))
            log(f"{kind} {own}: {before:.4g} to {after:.4g}")
        if progress:
            progress(done + 1, len(candidates))
    if not options:
        raise NonFiniteError("next", f"all {failed} candidates diverge with the identified constants")
    options.sort(key=lambda option: (option.after, -min(option.forecast.evidence.values(), default=0.0)))
    return Selection(goal, before, fit, prediction, options, failed, settings)


def _candidates(
    first: Experiment, known: Knowledge, lab: NextConfig, reframe: bool, seed: int, log: Callable[[str], None]
) -> list[tuple[str, dict[str, Any], Experiment | None, Trajectory | None]]:
    """Kind, settings, experiment and motion of each candidate; no experiment where the motion diverges.

    Kinds that are not possible are left out, unless there is no other.
    """
    frames = joint_frames(first.video)
    cameras = first.video[0].cameras
    candidates: list[tuple[str, dict[str, Any], Experiment | None, Trajectory | None]] = []
    if "camera" in lab.kinds:
        (path,) = _motions(known, [(first.model, first.body, first.motion, frames)])
        points = path.x.flatten(0, 1).cpu().numpy() if path else np.zeros((1, 3))
        for place, camera in second_cameras(cameras[0], points, reframe)[: lab.candidates]:
            video = [*first.video, unfilmed(frames, camera)]
            candidates.append(("camera", dict(place), path and replace(first, video=video), path))
    kinds, refusals = [kind for kind in lab.kinds if kind != "camera"], list[InputError]()
    left = lab.candidates - len(candidates)
    for k, kind in enumerate(kinds):
        count = (k + 1) * left // len(kinds) - k * left // len(kinds)
        if count < 1:
            continue
        own_seed = seed + list(STARTS).index(kind)
        try:
            starts = draw_starts(
                first.model, first.body, first.motion, frames[-1], lab, count, own_seed, kind
            )
        except InputError as error:
            refusals.append(error)
            log(str(error))
            continue
        spaced = [
            tuple(round(k * start.steps / (len(frames) - 1)) for k in range(len(frames))) for start in starts
        ]
        motions = [(s.model, s.body, s.motion, own) for s, own in zip(starts, spaced, strict=True)]
        for start, own, path in zip(starts, spaced, _motions(known, motions), strict=True):
            seen = cameras
            if reframe and path:
                views = video_views(
                    path.x.flatten(0, 1).cpu().numpy(), len(cameras), cameras.width, cameras.height
                )
                seen = as_cameras(views, cameras)
            experiment = Experiment(start.model, start.motion, start.body, [unfilmed(own, seen)])
            candidates.append((kind, start.settings, experiment if path else None, path))
    if not candidates:
        raise refusals[0]
    return candidates


@torch.no_grad()
def _motions(
    known: Knowledge, motions: Sequence[tuple[MPM, Reconstruction, InitialMotion, tuple[int, ...]]]
) -> list[Trajectory | None]:
    """Motions with the identified constants, together where they have the same model and frames."""
    paths: list[Trajectory | None] = [None] * len(motions)
    spec = known.fit.family.law_spec(known.fit.values)
    for model, frames in {(model, frames) for model, *_, frames in motions}:
        own = [k for k, motion in enumerate(motions) if (motion[0], motion[3]) == (model, frames)]
        starts = [motions[k][2].of_body(motions[k][1]) for k in own]
        laws = [analytic_law(spec, model.dt).to(start.x.device) for start in starts]
        batch = rollout_batch(model, laws, starts, steps=frames[-1], frames=frames, total=True)
        for k, path in zip(own, batch, strict=True):
            paths[k] = path
    return paths
