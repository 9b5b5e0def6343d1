"""95 % bands of response curves from laws that are compatible with a video.

**Constants.** Laws are sampled from the covariance of the constants (`constants_draws`). Such a band is correct if the
truth belongs to one of the families. Errors are not normal, so a band is the central interval of the samples with the
probability that `calibration.Quantiles` measured for its level.

**A structured correction** (`neuma_lib.mechanics.structured`) multiplies moduli m_a by exp(n_a(z)), with invariants z
of the elastic strain. Deviations g_a(z) of the n_a are sampled from a Gaussian process:

- The prior is a squared exponential kernel of length `LENGTH`, that of the correction's networks, and standard
  deviation `SILENT`, half the bound of the correction, plus a constant with the standard deviation of unbounded
  constants (`identify.spread`).
- The information of the video on constant factors of the moduli, the inverse A of their covariance, is distributed over
  the visited states, so that deviations cost <g^T A g> / 2. States are weighted by their squared strain, because the
  effect of a wrong modulus is proportional to the stress.

A band is about as wide as that of the constants in frequent states, wider in rare ones, and as wide as the bound of the
correction in states without data. The process uses random features (Rahimi and Recht 2007), so that each sample is a
law. The exponent n2 of the form "stretch", which n1 can replace, and outputs on constants that the base does not have
are not sampled. A part of the law is sampled even if training did not change it.

Replicates, reconstructions of the same video with other seeds, add a further error. `envelope` contains their bands.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.evaluation.calibration import GRID, SHOWN, quantiles_of
from neuma_lib.fitting.families import Family
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

DRAWS = 100
SILENT = LIMIT / 2  # standard deviation of the deviation of a log-modulus in states without data
LENGTH = 3 * STRAIN  # strain at which features of untrained networks have the correlation exp(-1/2)
FEATURES = 150  # random features of the Gaussian process
STATES = 20_000  # approximate maximum number of states of a motion
_DIFFERENCE = 1e-4  # step of an unbounded constant
Output = tuple[str, int]  # part of a law, and index of an output of its network
Band = tuple[np.ndarray, np.ndarray]


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
    """Sample laws around a structured one whose base was identified.

    Args:
        fit: ``best`` of its identified.json.
        visited: elastic deformation gradients of the motion that it predicts, shape (..., 3, 3).
        model_std: see `constants_draws`.
        spread: prior standard deviation of the unbounded constants.
        dt: time step [s].

    Raises:
        InputError: a law of the form "energy".
    """
    if law.elasticity.form != "stretch":
        problem = f'the form of the structured law is "{law.elasticity.form}", bands need "stretch"'
        raise InputError("law", problem)
    generator = np.random.default_rng(seed)
    field = RandomField(generator.standard_normal((FEATURES, INVARIANTS)), generator.uniform(size=FEATURES))
    states = visited.reshape(-1, 3, 3)
    _, sigma = rotation_and_singular_values(states[:: max(1, len(states) // STATES)].double())
    strain = sigma.clamp(min=STRETCH_MIN).log()
    felt = strain.square().sum(1, keepdim=True)
    observed = (field(invariants(strain)) * (felt / felt.mean()).sqrt()).numpy()
    outputs, covariance = _log_moduli(fit, dt, model_std)
    prior = np.append(np.full(FEATURES, SILENT), spread)
    posterior = field_covariance(observed, np.linalg.inv(covariance), prior)
    root = np.linalg.cholesky(posterior)
    draws = (root @ generator.standard_normal((len(root), count))).T.reshape(count, len(outputs), -1)
    return [_deviating(law, field, dict(zip(outputs, torch.from_numpy(rows), strict=True))) for rows in draws]


@dataclass(frozen=True)
class RandomField:
    """Random features of a squared exponential kernel of length `LENGTH`, and 1 as the last feature."""

    frequencies: np.ndarray  # standard normal, shape (M, 3)
    phases: np.ndarray  # in turns, shape (M,)

    def __call__(self, z: Tensor) -> Tensor:
        """Features (N, M + 1) at invariants z (N, 3)."""
        frequencies, phases = (torch.from_numpy(values).to(z) for values in (self.frequencies, self.phases))
        waves = (z / LENGTH @ frequencies.T + 2 * math.pi * phases).cos() * (2 / len(phases)) ** 0.5
        return torch.cat([waves, torch.ones_like(waves[:, :1])], dim=1)


def field_covariance(features: np.ndarray, information: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Posterior covariance (a f, a f) of weights w_a of log-moduli's deviations g_a = w_a . h.

    Args:
        features: h at states times the square roots of the states' weights (mean 1), shape (N, f).
        information: of the video on constant deviations, shape (a, a).
        prior: standard deviations of the weights w_a, shape (f,).
    """
    seen = features.T @ features / len(features)
    return np.linalg.inv(np.kron(information, seen) + np.diag(np.tile(prior**-2.0, len(information))))


class _Deviating:
    """A structured part with deviations added to the outputs of its network."""

    evaluate = Constitutive.evaluate

    def deviate(self, field: RandomField, rows: Mapping[int, Tensor]) -> None:
        """Set deviations: weights (f,) of the field's features by index of the output."""
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
    """A structured law with deviations of its outputs."""

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


def band(laws: Sequence[Law], curve: Callable[[Law], Tensor], inside: float | None = None) -> Band:
    """Lower and upper end (P,) of a central interval of the curves (P,) of sampled laws at each point.

    Non-finite values are ignored.

    Args:
        inside: share of the curves in the interval. None: that of the calibrated interval of constants on the grid at
            the level `calibration.SHOWN`.
    """
    inside = quantiles_of(GRID).nominal(SHOWN) if inside is None else inside
    curves = np.stack([curve(law).numpy() for law in laws])
    curves[~np.isfinite(curves)] = np.nan
    low, high = np.nanquantile(curves, [(1 - inside) / 2, (1 + inside) / 2], axis=0)
    return low, high


def envelope(bands: Sequence[Band]) -> Band:
    """The smallest band that contains the bands of all replicates."""
    lows, highs = zip(*bands, strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def _log_moduli(fit: Mapping[str, Any], dt: float, model_std: float) -> tuple[list[Output], np.ndarray]:
    """Outputs that act on constants of a family, and the first-order covariance of the logarithms of these."""
    family = Family("drawn", fit["law"])
    u = np.array(fit["unbounded"]["values"])

    def log_moduli(point: np.ndarray) -> dict[Output, float]:
        law = structured_law(family.law_spec(family.bounded(point)), dt)
        moduli = {("elasticity", 0): law.elasticity.lam + 2 * law.elasticity.mu / 3}
        moduli["elasticity", 1] = law.elasticity.mu
        if isinstance(law.plasticity, StructuredPlasticity):
            constants = law.plasticity.threshold, law.plasticity.friction, law.plasticity.rate
            moduli |= {("plasticity", k): value for k, value in enumerate(constants) if value > 0}
        return {output: float(np.log(value)) for output, value in moduli.items()}

    def difference(step: np.ndarray) -> np.ndarray:
        up, down = (np.array(list(log_moduli(u + s).values())) for s in (step, -step))
        return (up - down) / (2 * _DIFFERENCE)

    outputs = list(log_moduli(u))
    slope = np.stack([difference(step) for step in _DIFFERENCE * np.eye(len(u))], axis=1)
    covariance = slope @ np.array(fit["unbounded"]["covariance"]) @ slope.T
    return outputs, covariance + model_std**2 * np.eye(len(outputs))
