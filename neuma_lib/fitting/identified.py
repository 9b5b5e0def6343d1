"""Results of an identification: fits of all families, the selected one, and the uncertainty of its constants."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.fitting.families import FRICTION, Family
from neuma_lib.mechanics.combinations import Values, named_combinations, physical

_ASYMPTOTIC = math.log(2)
"""Largest change of a logarithm or logit between grids that the order of convergence explains."""


@dataclass
class FamilyFit:
    """Fit of a family."""

    family: Family  # the candidate
    values: Values  # its constants, or those of the last start if every rollout diverged
    # mean squared residual of the fitted frames at the last level of the pyramid, infinite if all diverged
    loss: float = math.inf
    held_out: float = math.inf  # mean squared residual of the held-out frames at the finest level
    score: float = math.inf  # logarithm of ``held_out`` plus the penalty on constants; lower is better
    # covariance (k, k) of the unbounded constants, including the uncertainty of the initial motions
    covariance: np.ndarray | None = None
    # the same by the Laplace approximation, with independent pixels: inverse curvature times ``loss``
    laplace: np.ndarray | None = None
    # fitted initial motion in each video, with its standard deviations
    motions: tuple[InitialMotion, ...] = ()
    refined: bool = False  # whether the fit reached the finest level
    rollouts: int = 0  # number of simulations
    steps: int = 0  # number of accepted Levenberg-Marquardt steps
    # lower bound of the Coulomb coefficient of a body that may stick, whose family is without it
    lowest_friction: float | None = None

    def contact_friction(self, settings: IdentifyConfig) -> dict[str, float]:
        """The fitted Coulomb coefficient of the body and its obstacles for JSON, empty if it was given.

        It is ``value`` with ``log_std``, the standard deviation of its logarithm, or ``at_least`` for a body that may
        stick.
        """
        if self.lowest_friction is not None:
            return {"at_least": self.lowest_friction}
        stds = {key: std for key, _, std in self.quantities(settings)}
        return {"value": self.values[FRICTION], "log_std": stds[FRICTION]} if FRICTION in stds else {}

    def disagreement(self, first: FamilyFit, ties: Sequence[FamilyFit]) -> np.ndarray:
        """Covariance (k, k) by which parts of the video and families with equal scores disagree.

        Args:
            first: fit to the first frames, whose difference from this fit to all frames is included.
            ties: fits of other families to the same frames, whose differences from ``first`` in shared constants are
                included.
        """
        u = self.family.unbounded
        before = u(first.values)
        changes = [u(self.values) - before]
        for tie in ties:
            shared = {key: tie.values.get(key, value) for key, value in first.values.items()}
            changes.append((u(shared) - before) / math.sqrt(len(ties) + 1))
        return sum(np.outer(change, change) for change in changes)

    def extrapolated(self, coarse: FamilyFit, refinement: float, more: float) -> FamilyFit:
        """This fit, of a grid with ``refinement`` times as many cells as that of another fit, extrapolated to dx = 0.

        On the same grid, which the truth shares, there is no such limit. Errors of the constants decrease with the
        number of particles, of which this fit has ``more`` times as many. The covariance is increased by the square of
        the distance to the limit of infinitely many.

        Errors of the unbounded constants decrease with dx (thin limbs, layers near the floor) or with dx^2 (smooth
        motion). The result is the limit of second order. Its covariance is increased by the square of the distance to
        the limit of first order. No combination of constants is more certain than in the other fit, because both are of
        one video. A constant that changes by more than `_ASYMPTOTIC` between the grids is not extrapolated further than
        one that changes by as much.
        """
        u = self.family.unbounded
        change = u(self.values) - u(coarse.values)
        if refinement > 1:
            first, second = (change / (refinement**order - 1) for order in (1, 2))
            remainder = first - second
        else:
            second, remainder = np.zeros_like(change), change / max(more - 1, 1)
        covariance = self.covariance
        if covariance is not None:
            if coarse.covariance is not None:
                variances, axes = np.linalg.eigh(coarse.covariance - covariance)
                covariance = covariance + axes * np.maximum(variances, 0) @ axes.T
            covariance = covariance + np.outer(remainder, remainder)
        second *= _ASYMPTOTIC / np.maximum(np.abs(change), _ASYMPTOTIC)
        return replace(self, values=self.family.bounded(u(self.values) + second), covariance=covariance)

    def log_covariance(
        self, of: Callable[[Values], Values], covariance: np.ndarray | None = None
    ) -> tuple[list[str], np.ndarray]:
        """Names (m,) and covariance (m, m) of logarithms of positive functions of the constants.

        The slope along a principal axis of the covariance is that of a secant, from one standard deviation below to one
        above (Julier and Uhlmann 1997), because a derivative vanishes where a constant is close to its bound.

        Args:
            covariance: of the unbounded constants (k, k). None: ``self.covariance``.
        """
        u, names = self.family.unbounded(self.values), list(of(self.values))
        variances, axes = np.linalg.eigh(self.covariance if covariance is None else covariance)

        def logs(point):
            return np.log(list(of(self.family.bounded(point)).values()))

        steps = (axes * np.sqrt(np.maximum(variances, 0))).T
        halves = np.stack([0.5 * (logs(u + step) - logs(u - step)) for step in steps], axis=1)
        return names, halves @ halves.T

    def as_dict(self, settings: IdentifyConfig) -> dict[str, Any]:
        """Plain numbers for JSON."""
        plain = {"law": self.family.law_spec(self.values), "rollouts": self.rollouts, "steps": self.steps}
        if not math.isfinite(self.loss):
            return {**plain, "diverged": True}
        plain |= {"diverged": False, "refined": self.refined, "loss": self.loss}
        if math.isfinite(self.score):
            plain |= {"held_out_loss": self.held_out, "score": self.score}
        if self.covariance is not None:
            names, covariance = self.log_covariance(lambda values: values)
            stds = np.sqrt(np.diag(covariance))
            plain["constants"] = {
                key: {"value": self.values[key], "log_std": float(std)}
                for key, std in zip(names, stds, strict=True)
            }
            plain["quantities"] = {
                key: {"value": value, "log_std": std, "determined": std < settings.determined}
                for key, value, std in self.quantities(settings)
            }
            plain["combinations"] = self.combinations(settings)
            plain["unbounded"] = self.family.unbounded_dict(self.values, self.covariance)
            if self.laplace is not None:
                names, covariance = self.log_covariance(named_combinations, self.laplace)
                for key, std in zip(names, np.sqrt(np.diag(covariance)), strict=True):
                    plain["quantities"][key]["laplace_log_std"] = float(std)
                own = len(plain["unbounded"]["constants"])
                plain["unbounded"]["laplace"] = self.laplace[:own, :own].tolist()
            plain["start"] = self.motions[0].as_dict()
        return plain

    def quantities(self, settings: IdentifyConfig) -> list[tuple[str, float, float]]:
        """Name, value and standard deviation of the logarithm of the named combinations."""
        names, covariance = self.log_covariance(named_combinations)
        stds = np.sqrt(np.diag(covariance) + settings.model_std**2)
        return list(zip(names, named_combinations(self.values).values(), stds.tolist(), strict=True))

    def combinations(self, settings: IdentifyConfig) -> list[dict[str, Any]]:
        """Products of powers of the physical constants with independent errors, the best determined first."""
        names, covariance = self.log_covariance(physical)
        variances, axes = np.linalg.eigh(covariance)
        logs = np.log(list(physical(self.values).values()))
        combinations = []
        for variance, axis in zip(variances, axes.T, strict=True):
            axis = axis * np.sign(axis[np.abs(axis).argmax()])
            std = math.sqrt(max(variance, 0.0) + settings.model_std**2)
            combinations.append({
                "powers": dict(zip(names, axis.tolist(), strict=True)),
                "log_value": float(axis @ logs),
                "log_std": std,
                "determined": std < settings.determined,
            })  # fmt: skip
        return combinations


@dataclass
class Identified:
    """Result of `identify`."""

    # the selected family, fitted to all frames on the grid of the simulation. It predicts on that grid.
    best: FamilyFit
    ties: list[str]  # names of other families with an equal score
    # all candidates at their evaluation, by name, on the finer grid where families were compared there
    fits: dict[str, FamilyFit]
    frames: list[tuple[int, ...]]  # steps of the fitted frames of each video
    held_out: list[tuple[int, ...]]  # steps of the held-out frames of each video
    rollouts: int  # number of simulations, some of which families share
    grid: int  # cells along the unit cube of the simulation
    settings: IdentifyConfig = field(repr=False)
    # the selected family with its constants extrapolated to a cell size of zero, for other simulators and
    # data sheets. None without a second grid.
    material: FamilyFit | None = None
    # names of the families whose scores are compared, which all have the same grid
    compared: Sequence[str] = ()

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers for JSON; ``law`` is a specification for `analytic_law`.

        ``contact_friction`` is that of `FamilyFit.contact_friction` if it was fitted.
        """
        videos = [
            {"start": motion.as_dict(), "frames": list(frames), "held_out_frames": list(held_out)}
            for motion, frames, held_out in zip(self.best.motions, self.frames, self.held_out, strict=True)
        ]
        friction = self.best.contact_friction(self.settings)
        return {
            "family": self.best.family.name,
            "grid": self.grid,
            "ties": self.ties,
            "compared": list(self.compared),
            "law": self.best.family.law_spec(self.best.values),
            **({FRICTION: friction} if friction else {}),
            "says": self.summary(),
            "best": self.best.as_dict(self.settings),
            **({"material": self.material.as_dict(self.settings)} if self.material else {}),
            "families": {name: fit.as_dict(self.settings) for name, fit in self.fits.items()},
            **videos[0],
            **({"further_videos": videos[1:]} if videos[1:] else {}),
            "rollouts": self.rollouts,
        }

    def summary(self) -> str:
        """Summary line: family, constants, and determined quantities."""
        fit = self.material or self.best
        tied = f" (tie with {', '.join(self.ties)})" if self.ties else ""
        values = ", ".join(f"{key} = {value:.4g}" for key, value in fit.values.items())
        if self.material:
            on_grid = ", ".join(f"{key} = {value:.4g}" for key, value in self.best.values.items())
            values = f"{values} of the material, {on_grid} on this grid"
        if fit.lowest_friction is not None:
            values += f", {FRICTION} >= {fit.lowest_friction:.2g} (it may stick)"
        determined = {key: std < self.settings.determined for key, _, std in fit.quantities(self.settings)}
        lists = [
            f"{'determined' if wanted else 'not determined'}: {', '.join(names)}"
            for wanted in (True, False)
            if (names := [key for key, value in determined.items() if value == wanted])
        ]
        return f"{fit.family.name}{tied}: {values}; {'; '.join(lists)}"


def recorded_friction(identified: Mapping[str, Any]) -> float | None:
    """Coulomb coefficient in the content of identified.json, infinite for a body that may stick. None: it was given."""
    record = identified.get(FRICTION)
    return None if record is None else record.get("value", math.inf)
