"""Identify the materials of several bodies that touch each other in a video, and the friction between them.

All constants, the initial motions of all bodies and the Coulomb coefficients of all pairs are unknowns of one
least-squares problem, whose images show all bodies. A body is therefore also seen by what it does to the others.

Families are selected body by body. A candidate of a body is fitted with the constants of the others fixed: first at the
coarsest level of the image pyramid, from guesses, and then at the finest level around the joint fit, where held-out
frames decide as in `identify`. The joint fit to all frames follows. There is no finer grid.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.families import Bodies, Family
from neuma_lib.fitting.family_run import FamilyRun
from neuma_lib.fitting.identified import FamilyFit, Identified
from neuma_lib.fitting.identify import select_family
from neuma_lib.fitting.video_residuals import Candidate, VideoResiduals
from neuma_lib.mechanics.combinations import Values
from neuma_lib.sim.bodies import Pair
from neuma_lib.sim.model import MPM
from neuma_lib.splatting.observation import Observation

MANY_HIDDEN = 0.5
"""Share of a body that the others hide in some frame from which the summary warns."""
_FIRST_STARTS = (-2, -1, 1, 2)
"""Powers of 4 of the limits of a flow, and of E, from which a family starts, in addition to its guess."""


@dataclass
class IdentifiedBodies:
    """Result of `identify_bodies`.

    Attributes:
        bodies: by name, as `identify` of one body. Its uncertainty includes that of the others.
        particles: number of particles of each body.
        pairs: Coulomb coefficient of each pair of bodies by its name, and the standard deviation of its logarithm.
        hidden: share of each body that the others hide in each compared frame, (T, bodies), by the identified laws.
            1 where no image shows it.
        rollouts: number of simulations.
    """

    bodies: dict[str, Identified]
    particles: list[int]
    pairs: dict[tuple[str, str], tuple[float, float]]
    hidden: np.ndarray
    rollouts: int

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON."""
        pairs = [
            {"bodies": list(names), "friction": value, "log_std": std}
            for names, (value, std) in self.pairs.items()
        ]
        bodies = {name: each.as_dict() for name, each in self.bodies.items()}
        starts = [
            {"name": name, "particles": count, **bodies[name]["start"]}
            for name, count in zip(bodies, self.particles, strict=True)
        ]
        start = {"bodies": starts, "separate": True}
        hidden = dict(zip(bodies, self.hidden.T.tolist(), strict=True))
        return {"bodies": bodies, "pairs": pairs, "hidden": hidden, "start": start, "rollouts": self.rollouts}

    def summary(self) -> list[str]:
        """A line for each body and pair."""
        return [
            *(f"{name}: {each.summary()}" for name, each in self.bodies.items()),
            *(
                f"{name}: the others hide {hidden.mean():.0%} of it in the mean and {hidden.max():.0%} at most, so"
                " that few pixels determine its constants"
                for name, hidden in zip(self.bodies, self.hidden.T, strict=True)
                if hidden.max() > MANY_HIDDEN
            ),
            *(
                f"friction of {a} and {b}: {value:.2g}, log std {std:.2g}"
                for (a, b), (value, std) in self.pairs.items()
            ),
        ]


def identify_bodies(
    model: MPM,
    motions: Mapping[str, InitialMotion],
    bodies: Sequence[Reconstruction],
    observation: Observation | Sequence[Observation],
    settings: IdentifyConfig,
    given: Mapping[str, str] | None = None,
    *,
    log: Callable[[str], None] = lambda text: None,
) -> IdentifiedBodies:
    """Identify family and constants of each of several bodies and the friction of all pairs.

    Args:
        model: simulator constants. Frictions of its pairs are not used.
        motions: estimates of the initial motions by name of the body.
        bodies: reconstructed particles and Gaussians of the bodies in the same order.
        observation: the video, or several of the same motion, of all bodies.
        settings: candidates and hyper-parameters.
        given: the families of bodies by name, which are then not selected.
        log: receives a line for every step of the identification.

    Raises:
        InputError: fewer than two bodies, fitted friction of obstacles, or no family.
        NonFiniteError: every candidate of a body diverges.
    """
    names = list(motions)
    if len(names) < 2 or len(names) != len(bodies):
        raise InputError("bodies", f"{len(bodies)} bodies with {len(names)} motions must be two or more")
    if settings.contact_friction == "fitted":
        problem = "is fitted for one body only"
        raise InputError("identify.contact_friction", problem, "Set it to given for several bodies")
    if not settings.families:
        raise InputError("identify.families", "it has no candidates", "Add at least one elasticity")
    families = {name: Family(name, law.plain()) for name, law in settings.families.items()}
    simple_first = sorted(families.values(), key=lambda family: len(family.constants))
    candidates = [[families[given[name]]] if name in (given or {}) else simple_first for name in names]
    pairs = list(combinations(range(len(names)), 2))
    model = replace(model, pairs=tuple(Pair(*pair) for pair in pairs))
    video = VideoResiduals(model, list(motions.values()), bodies, observation, settings)
    search = _Search(names, pairs, video, settings, log)
    search.begin(candidates)
    fits = search.select(candidates)
    return search.finish(fits)


class _Search:
    """Families, constants and deviations of the bodies during an identification.

    Attributes:
        families: of each body at present.
        values: constants of all bodies and pairs at present.
        deviations: of the initial motions and poses at present.
    """

    def __init__(
        self,
        names: Sequence[str],
        pairs: Sequence[tuple[int, int]],
        video: VideoResiduals,
        settings: IdentifyConfig,
        log: Callable[[str], None],
    ):
        self.names, self.pairs, self.video, self.settings, self.log = names, pairs, video, settings, log
        self.families: list[Family] = []
        self.values: Values = {}
        self.deviations = np.zeros(video.deviations)
        self._last = len(settings.pyramid) - 1

    def begin(self, candidates: Sequence[Sequence[Family]]) -> None:
        """Select a family of each body at the coarsest level with the others fixed, and fit all together there."""
        self.families = [own[0] for own in candidates]
        self.values = self._together().guess
        self.video.hold_out(self._together(), self.settings.held_out)
        for k, own in enumerate(candidates):
            runs = [self._run(k, family, self._starts(family), 0) for family in own]
            self._take(k, self._best(k, runs))
        self._joint(range(max(1, self._last)), self.video.fitted).differentiate()

    def select(self, candidates: Sequence[Sequence[Family]]) -> list[tuple[dict[str, FamilyFit], list[str]]]:
        """Select a family of each body by the held-out frames, with the others fixed at the joint fit.

        Returns:
            for each body its candidates by name, and the names of tied families.
        """
        result = []
        for k, own in enumerate(candidates):
            if len(own) == 1:
                result.append(({}, []))
                continue
            middle = max(0, self._last - 1)
            runs = []
            # From the fit before, and from guesses, since each may be near a local minimum.
            for family in own:
                groups = [family.with_guesses(self._of_body(k))], self._starts(family)
                tried = [self._run(k, family, starts, middle) for starts in groups]
                runs.append(min(tried, key=lambda run: (not run.alive, run.loss)))
            limit = self.settings.prune_factor * self._best(k, runs).fit.cost
            for run in runs:
                run.alive = run.alive and run.fit.cost <= limit
                if run.alive:
                    run.refine(self._last, rough=True)
            fits = {family.name: self._fit(k, run) for family, run in zip(own, runs, strict=True)}
            best, ties = select_family(list(fits.values()), self.settings)
            self._take(k, runs[[family.name for family in own].index(best.family.name)])
            result.append((fits, ties))
            tied = f", tie with {', '.join(ties)}" if ties else ""
            self.log(f"{self.names[k]}: {best.family.name}{tied}")
        return result

    def finish(self, fits: Sequence[tuple[dict[str, FamilyFit], list[str]]]) -> IdentifiedBodies:
        """The joint fit of the selected families to all frames."""
        self._joint([self._last], self.video.fitted).differentiate()
        run = self._joint([self._last], len(self.video.frames))
        best, video = run.score(), self.video
        frames = [video.frames[: video.fitted]], [video.frames[video.fitted :]]
        stds = np.sqrt(np.diag(best.covariance))
        bodies = {}
        for k, (name, (others, ties)) in enumerate(zip(self.names, fits, strict=True)):
            own = self._fit(k, run)
            bodies[name] = Identified(
                own,
                ties,
                others or {own.family.name: own},
                *frames,
                video.rollouts,
                video.model.grid,
                self.settings,
            )
        together = self._together()
        frictions = together.pair_frictions(self.values)
        hidden = video.hidden_shares(
            Candidate(together.law_spec(self.values), self.deviations, None, frictions)
        )
        return IdentifiedBodies(
            bodies,
            video.particles,
            {
                (self.names[a], self.names[b]): (self.values[key], float(stds[i]))
                for (a, b), (key, i) in zip(self.pairs, together.pairs.items(), strict=True)
            },
            np.nan_to_num(hidden.numpy(), nan=1.0),
            video.rollouts,
        )

    def _together(self) -> Bodies:
        return Bodies(dict(zip(self.names, self.families, strict=True)), self.pairs)

    def _of_body(self, k: int) -> Values:
        return self._together().of_body(k, self.values)

    def _starts(self, family: Family) -> list[Values]:
        """Guesses of a family, with other limits of its flow and other stiffnesses."""
        u = family.unbounded(family.guess)
        stiffness = np.array([key == "E" for key in family.constants])
        others = [family.bounded(u + math.log(4) * n * stiffness) for n in _FIRST_STARTS]
        return [family.guess, *others, *family.with_other_limits(family.guess, _FIRST_STARTS)]

    def _run(self, k: int, family: Family, starts: Sequence[Values], level: int) -> FamilyRun:
        """Fit of a family of a body at a level, with the constants of the other bodies and the frictions known."""
        families = [family if j == k else own for j, own in enumerate(self.families)]
        others = {key: value for key, value in self.values.items() if not key.startswith(f"{self.names[k]}.")}
        together = Bodies(dict(zip(self.names, families, strict=True)), self.pairs, others)
        run = FamilyRun(together, [self.video], [self.video.fitted], self.settings)
        named = [{f"{self.names[k]}.{key}": value for key, value in start.items()} for start in starts]
        run.begin([{**together.guess, **start} for start in named], level, self.deviations, rough=True)
        if run.alive:
            values = ", ".join(f"{key} {value:.3g}" for key, value in together.of_body(k, run.values).items())
            self.log(f"{self.names[k]} {family.name} at level {level}: loss {run.loss:.3e}, {values}")
        return run

    def _best(self, k: int, runs: Sequence[FamilyRun]) -> FamilyRun:
        alive = [run for run in runs if run.alive]
        if not alive:
            raise NonFiniteError("identify", f"every candidate of {self.names[k]} diverges")
        return min(alive, key=lambda run: run.fit.cost)

    def _take(self, k: int, run: FamilyRun) -> None:
        """Set the family and constants of a body to those of a fit."""
        self.families[k] = run.family.families[k]
        others = {key: value for key, value in self.values.items() if not key.startswith(f"{self.names[k]}.")}
        self.values = {**run.values, **others}

    def _joint(self, levels: Sequence[int], frames: int) -> FamilyRun:
        """Fit all constants together at levels of the pyramid to the first frames."""
        # More unknowns share the gain of a step.
        gain = self.settings.min_gain / len(self.names) ** 2
        settings = self.settings.model_copy(update={"min_gain": gain})
        run = FamilyRun(self._together(), [self.video], [frames], settings)
        first, *others = levels
        run.begin([self.values], first, self.deviations)
        if not run.alive:
            raise NonFiniteError("identify", "the simulation of all bodies together diverges")
        for level in others:
            run.refine(level)
        self.values, self.deviations = run.values, run.deviations.copy()
        self.log(
            f"together, {frames} frames at level {levels[-1]}: loss {run.loss:.3e}, "
            + ", ".join(f"{key} {value:.3g}" for key, value in run.values.items())
        )
        return run

    def _fit(self, k: int, run: FamilyRun) -> FamilyFit:
        """The part of a fit that belongs to a body."""
        if not run.alive:
            return FamilyFit(run.family.families[k], run.family.of_body(k, run.values))
        whole, own = run.score(), run.family.own(k)
        part = np.ix_(own, own)
        return replace(
            whole,
            family=run.family.families[k],
            values=run.family.of_body(k, whole.values),
            covariance=whole.covariance[part],
            laplace=whole.laplace[part],
            motions=whole.motions[k : k + 1],
        )
