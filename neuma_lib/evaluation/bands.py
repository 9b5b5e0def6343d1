"""Which laws a video leaves possible: 95 % bands of response curves, by drawing laws.

**Constants.** An identified family has a covariance of its unbounded constants (`neuma_lib.fitting.families`). Laws are
drawn from that normal distribution, with what all images share (`identify.model_std`) on top; families that tie with
the best one give equal parts of the draws. Such a band is right if the truth lies in one of these families.

**A structured correction** (`neuma_lib.mechanics.structured`) multiplies moduli m_a by exp(n_a(z)), z the invariants of
the elastic strain. Deviations g_a(z) of the n_a are drawn from a Gaussian process:

- Before the video is seen: a squared exponential kernel of length `LENGTH`, that of the correction's own networks, and
  standard deviation `SILENT`, so that two of them are the bound of the correction, whatever it was trained to; and a
  constant with the standard deviation that `identify` gives to unbounded constants (`identify.spread`).
- The video: its information on constant factors of the moduli, the inverse A of their covariance, is spread over the
  states that it shows, so that deviations cost <g^T A g> / 2. A state counts by its squared strain, since a modulus
  that is wrong by some factor is felt in proportion to the stress.

So a band is about as wide as that of the constants where the video has shown most, wider in seldom states, and as wide
as the correction is free where the video is silent. The process is one of random features (Rahimi and Recht 2007), so
that a draw is a law. Not drawn: the exponent n2 of the form "stretch", whose part n1 can play, and outputs on constants
that the base does not have. A part of the law is drawn even if training left it as it was.

Chains, that is other reconstructions of the same video, are one more source of error: `envelope` holds all of theirs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.fitting.families import Family
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.elasticity import STRETCH_MIN
from neuma_lib.mechanics.law import Constitutive, Law, Weights
from neuma_lib.mechanics.singular_values import rotation_and_singular_values
from neuma_lib.mechanics.structured import (
    INVARIANTS,
    LIMIT,
    STRAIN,
    StructuredElasticity,
    StructuredLaw,
    StructuredPlasticity,
    invariants,
    structured_law,
)

COVERED = 0.95
DRAWS = 100
SILENT = LIMIT / 2
"""Standard deviation of a log-modulus's deviation where the video is silent."""
LENGTH = 3 * STRAIN
"""Strain at which features of untrained networks are correlated by exp(-1/2)."""
FEATURES = 150
"""Random features of the Gaussian process."""
STATES = 20_000
"""About the most states of a motion that are looked at."""
_DIFFERENCE = 1e-4  # of an unbounded constant
Output = tuple[str, int]
"""Part of a law and number of an output of its network."""
Band = tuple[np.ndarray, np.ndarray]


def constants_draws(
    found: Mapping[str, Any], model_std: float, dt: float, count: int, seed: int
) -> list[Law]:
    """Laws of the family in an identified.json, and of those that tie with it, that the video leaves possible.

    Args:
        found: content of the file.
        model_std: standard deviation of every unbounded constant beside that from the images.
        dt: time step [s].
        count: about how many; every family has the same number.
    """
    generator = np.random.default_rng(seed)
    fits = [found["best"], *(found["families"][name] for name in found["ties"])]
    each, laws = -(-count // len(fits)), []
    for fit in fits:
        family = Family("drawn", fit["law"])
        covariance = np.array(fit["unbounded"]["covariance"]) + model_std**2 * np.eye(len(family.constants))
        draws = generator.multivariate_normal(fit["unbounded"]["values"], covariance, each)
        laws += [analytic_law(family.law_spec(family.bounded(u)), dt) for u in draws]
    return laws


def corrected_draws(
    law: StructuredLaw,
    fit: Mapping[str, Any],
    visited: Tensor,
    model_std: float,
    spread: float,
    dt: float,
    count: int,
    seed: int,
) -> list[Law]:
    """Laws around a structured one, whose base was identified, that the video leaves possible.

    Args:
        law: the structured law.
        fit: ``best`` of its identified.json.
        visited: elastic deformation gradients of its own motion, as they occur, shape (..., 3, 3).
        model_std: as of `constants_draws`.
        spread: standard deviation of the unbounded constants before the video is seen.
        dt: time step [s].
        count: how many.

    Raises:
        InputError: a law of the form "energy".
    """
    if law.elasticity.form != "stretch":
        raise InputError(f"bands are drawn of structured laws of the form stretch, not {law.elasticity.form}")
    generator = np.random.default_rng(seed)
    field = RandomField(generator.standard_normal((FEATURES, INVARIANTS)), generator.uniform(size=FEATURES))
    states = visited.reshape(-1, 3, 3)
    _, sigma = rotation_and_singular_values(states[:: max(1, len(states) // STATES)].double())
    strain = sigma.clamp(min=STRETCH_MIN).log()
    felt = strain.square().sum(1, keepdim=True)
    shown = (field(invariants(strain)) * (felt / felt.mean()).sqrt()).numpy()
    outputs, covariance = _log_moduli(fit, dt, model_std)
    prior = np.append(np.full(FEATURES, SILENT), spread)
    posterior = field_covariance(shown, np.linalg.inv(covariance), prior)
    root = np.linalg.cholesky(posterior)
    draws = (root @ generator.standard_normal((len(root), count))).T.reshape(count, len(outputs), -1)
    return [_deviating(law, field, dict(zip(outputs, torch.from_numpy(rows), strict=True))) for rows in draws]


@dataclass(frozen=True)
class RandomField:
    """Features of a squared exponential kernel of length `LENGTH`, and 1 as the last one.

    Attributes:
        frequencies: standard normal, shape (M, 3).
        phases: in turns, shape (M,).
    """

    frequencies: np.ndarray
    phases: np.ndarray

    def __call__(self, z: Tensor) -> Tensor:
        """Features (N, M + 1) at invariants z (N, 3)."""
        frequencies, phases = (torch.from_numpy(values).to(z) for values in (self.frequencies, self.phases))
        waves = (z / LENGTH @ frequencies.T + 2 * math.pi * phases).cos() * (2 / len(phases)) ** 0.5
        return torch.cat([waves, torch.ones_like(waves[:, :1])], dim=1)


def field_covariance(features: np.ndarray, information: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Posterior covariance (a f, a f) of weights w_a of log-moduli's deviations g_a = w_a . h.

    Args:
        features: h at states, scaled by the roots of their weights, whose mean is 1, shape (N, f).
        information: of the video on constant deviations (a,), shape (a, a).
        prior: standard deviations of weights, shape (f,).
    """
    seen = features.T @ features / len(features)
    return np.linalg.inv(np.kron(information, seen) + np.diag(np.tile(prior**-2.0, len(information))))


class _Deviating:
    """A structured part whose network's outputs deviate; evaluated by its `response`, which asks for them."""

    evaluate = Constitutive.evaluate

    def deviate(self, field: RandomField, rows: Mapping[int, Tensor]) -> None:
        """Deviations with weights (f,) of the field's features by the number of the output."""
        self.field, self.rows = field, rows

    def outputs(self, z: Tensor, weights: Weights) -> Tensor:
        n, features = list(super().outputs(z, weights).split(1, dim=1)), self.field(z)
        for k, row in self.rows.items():
            n[k] = (n[k] + features @ row[:, None]).clamp(-LIMIT, LIMIT)
        return torch.cat(n, dim=1)


class _DeviatingElasticity(_Deviating, StructuredElasticity):
    pass


class _DeviatingPlasticity(_Deviating, StructuredPlasticity):
    pass


def _deviating(law: StructuredLaw, field: RandomField, rows: Mapping[Output, Tensor]) -> Law:
    """A structured law whose outputs deviate."""

    def of_part(name: str) -> dict[int, Tensor]:
        return {k: row for (part, k), row in rows.items() if part == name}

    elasticity = _DeviatingElasticity(law.elasticity.analytic, "stretch", law.elasticity.weights())
    elasticity.deviate(field, of_part("elasticity"))
    if isinstance(law.plasticity, StructuredPlasticity):
        plasticity = _DeviatingPlasticity(law.plasticity.analytic, law.plasticity.weights())
        plasticity.deviate(field, of_part("plasticity"))
    else:
        plasticity = law.plasticity
    return Law(elasticity, plasticity)


def band(laws: Sequence[Law], curve: Callable[[Law], Tensor]) -> Band:
    """Lower and upper end (P,) of what `COVERED` of the curves (P,) of laws lie between at each point.

    A curve counts where it is finite.
    """
    curves = np.stack([curve(law).numpy() for law in laws])
    curves[~np.isfinite(curves)] = np.nan
    low, high = np.nanquantile(curves, [(1 - COVERED) / 2, (1 + COVERED) / 2], axis=0)
    return low, high


def envelope(bands: Sequence[Band]) -> Band:
    """The band that holds all bands of several chains."""
    lows, highs = zip(*bands, strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def _log_moduli(fit: Mapping[str, Any], dt: float, model_std: float) -> tuple[list[Output], np.ndarray]:
    """Outputs of networks whose constants a family has, and the covariance of their logarithms, to first order."""
    family = Family("drawn", fit["law"])
    u = np.array(fit["unbounded"]["values"])

    def logs(point: np.ndarray) -> dict[Output, float]:
        law = structured_law(family.law_spec(family.bounded(point)), dt)
        moduli = {("elasticity", 0): law.elasticity.lam + 2 * law.elasticity.mu / 3}
        moduli["elasticity", 1] = law.elasticity.mu
        if isinstance(law.plasticity, StructuredPlasticity):
            constants = law.plasticity.threshold, law.plasticity.friction, law.plasticity.rate
            moduli |= {("plasticity", k): value for k, value in enumerate(constants) if value > 0}
        return {output: float(np.log(value)) for output, value in moduli.items()}

    outputs = list(logs(u))
    slope = np.stack(
        [
            [
                (up - down) / (2 * _DIFFERENCE)
                for up, down in zip(logs(u + step).values(), logs(u - step).values(), strict=True)
            ]
            for step in _DIFFERENCE * np.eye(len(u))
        ],
        axis=1,
    )
    covariance = slope @ np.array(fit["unbounded"]["covariance"]) @ slope.T
    return outputs, covariance + model_std**2 * np.eye(len(outputs))
