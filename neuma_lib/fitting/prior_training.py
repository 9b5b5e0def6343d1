"""Priors: neural constitutive laws trained on published analytic ones (the paper's M_0, NCLaw).

A regression (`neuma_lib.fitting.prior_regression`) leads from an analytic law to a pair of networks, whose rollout is
compared with the law's on throws that training has not seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from neuma_lib.config.priors import RegressionConfig
from neuma_lib.errors import NonFiniteError
from neuma_lib.fitting.prior_regression import train_by_regression
from neuma_lib.fitting.prior_throws import Progress, random_throw, reference_law
from neuma_lib.geometry.chamfer import chamfer_sequence
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.neural import NeuralLaw

METHOD = "regression"
"""How priors are trained, in their files."""
CLOSE = 0.1
"""Chamfer distance [1e-4 m^2] of a prior from its law that the closest of the authors' own priors have."""
_JUDGE_SEEDS = 10_000
"""Added to a prior's seed: the throws that judge it are not those that it was trained on."""


def train_prior(
    spec: Mapping[str, Any],
    settings: RegressionConfig,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[NeuralLaw, dict[str, Any]]:
    """Train a neural law on an analytic one.

    Args:
        spec: the analytic law, see :func:`neuma_lib.mechanics.analytic.analytic_law`.
        settings: of the regression.
        seed: of throws, noise, initial weights and batches.
        progress: called with (iterations done, iterations in all, loss).

    Returns:
        the law, and a report of plain numbers: losses, and how its rollout differs from its law's on unseen
        throws, see :func:`judge`.

    Raises:
        InputError: unknown material.
        NonFiniteError: training or a rollout diverged.
    """
    law, report = train_by_regression(spec, settings, seed, progress or (lambda done, total, loss: None))
    report["method"] = METHOD
    report.update(judge(law, spec, settings, seed))
    return law, report


def judge(
    law: Law,
    spec: Mapping[str, Any],
    settings: RegressionConfig,
    seed: int = 0,
    throws: int = 3,
    frames: int = 20,
) -> dict[str, float]:
    """How far a law's rollouts are from those of the analytic law, on throws of their own.

    Returns:
        ``chamfer`` (mean squared nearest-neighbour distance, both directions summed [1e-4 m^2]) and ``rmse``
        of corresponding particles [m], means over frames and throws; ``rmse_worst``, the worst frame's [m].
    """
    generator = torch.Generator().manual_seed(_JUDGE_SEEDS + seed)
    chamfers, errors = [], []
    reference = reference_law(spec, settings)
    for _ in range(throws):
        throw = random_throw(reference, generator, settings)
        steps = [round(i * throw.steps / frames) for i in range(1, frames + 1)]
        try:
            with torch.no_grad():
                seen, truth = throw.run(law, steps), throw.run(reference, steps)
        except NonFiniteError as error:
            raise NonFiniteError(
                "prior", f"the trained law is unstable ({error.detail}); train it longer"
            ) from error
        errors.append((seen.x - truth.x).square().sum(-1).mean(-1).sqrt())
        chamfers.append(float(chamfer_sequence(seen.x, truth.x).mean()))
    rmse = torch.stack(errors)
    return {
        "chamfer": sum(chamfers) / throws,
        "rmse": float(rmse.mean()),
        "rmse_worst": float(rmse.max()),
    }


def remark(report: Mapping[str, Any]) -> str:
    """How far a prior is from its law, in a line; with a warning if its Chamfer distance is not below `CLOSE`.

    Args:
        report: of :func:`train_prior`.
    """
    far = f"RMSE {1e3 * report['rmse']:.2f} mm, Chamfer {report['chamfer']:.4f}e-4 m^2"
    text = f"rollout against its law: {far}"
    if report["chamfer"] < CLOSE:
        return text
    return (
        f"{text}. WARNING: this prior follows its law only roughly (below {CLOSE:g}e-4 m^2 is close); what is learned "
        "from it starts there, not at the law (docs/materials.md, Priors)"
    )
