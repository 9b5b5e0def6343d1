"""Priors: neural constitutive laws trained on published analytic ones (the paper's M_0, NCLaw).

A regression (`neuma_lib.fitting.prior_regression`) fits a pair of networks to an analytic law. Their rollouts are then
compared with those of the law on unseen motions.
"""

from collections.abc import Mapping
from typing import Any

import torch

from neuma_lib.config.priors import RegressionConfig
from neuma_lib.errors import NonFiniteError
from neuma_lib.fitting.prior_launches import Progress, random_launch, reference_law
from neuma_lib.fitting.prior_regression import train_by_regression
from neuma_lib.geometry.chamfer import chamfer_sequence
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.neural import NeuralLaw

METHOD = "regression"  # training method stored in the files of priors
CLOSE = 0.1  # Chamfer distance between prior and law of the best priors of the authors [1e-4 m^2]
_EVALUATION_SEEDS = 10_000
"""Offset of the seed for evaluation, so that its motions differ from those of the training."""


def train_prior(
    spec: Mapping[str, Any], settings: RegressionConfig, seed: int = 0, progress: Progress | None = None
) -> tuple[NeuralLaw, dict[str, Any]]:
    """Train a neural law on an analytic one.

    Args:
        spec: the analytic law, see :func:`neuma_lib.mechanics.analytic.analytic_law`.
        seed: seed of motions, noise, initial weights and batches.
        progress: called with (finished iterations, all iterations, loss).

    Returns:
        The law, and a report of plain numbers: losses and the results of :func:`evaluate_prior`.

    Raises:
        InputError: the analytic law is unknown.
        NonFiniteError: training or a rollout diverged.
    """
    law, report = train_by_regression(spec, settings, seed, progress or (lambda done, total, loss: None))
    report["method"] = METHOD
    report.update(evaluate_prior(law, spec, settings, seed))
    return law, report


def evaluate_prior(
    law: Law,
    spec: Mapping[str, Any],
    settings: RegressionConfig,
    seed: int = 0,
    launches: int = 12,
    frames: int = 20,
) -> dict[str, float]:
    """Deviation of rollouts of a law from those of the analytic law, on unseen motions.

    A launch that lands on an edge can amplify the deviation tenfold, so that the mean of three is mostly noise.

    Returns:
        Means over frames and motions of ``chamfer``, the squared nearest-neighbour distance summed over both directions
        [1e-4 m^2], and of ``rmse`` of corresponding particles [m]; ``rmse_worst``, that of the worst frame [m].
    """
    generator = torch.Generator().manual_seed(_EVALUATION_SEEDS + seed)
    chamfers, errors = [], []
    reference = reference_law(spec, settings)
    for _ in range(launches):
        launch = random_launch(reference, generator, settings)
        steps = [round(i * launch.steps / frames) for i in range(1, frames + 1)]
        try:
            with torch.no_grad():
                path, truth = launch.run(law, steps), launch.run(reference, steps)
        except NonFiniteError as error:
            problem = f"the trained law is unstable ({error.detail}). Increase iterations"
            raise NonFiniteError("prior", problem) from error
        errors.append((path.x - truth.x).square().sum(-1).mean(-1).sqrt())
        chamfers.append(float(chamfer_sequence(path.x, truth.x).mean()))
    rmse = torch.stack(errors)
    return {"chamfer": sum(chamfers) / launches, "rmse": float(rmse.mean()), "rmse_worst": float(rmse.max())}


def remark(report: Mapping[str, Any]) -> str:
    """Summary line of a report of :func:`train_prior`, with a warning if the Chamfer distance is not below `CLOSE`."""
    errors = f"RMSE {1e3 * report['rmse']:.2f} mm, Chamfer {report['chamfer']:.4f}e-4 m^2"
    text = f"rollout of the prior compared with its law: {errors}"
    if report["chamfer"] < CLOSE:
        return text
    return (
        f"{text}. WARNING: the prior approximates its law poorly (a good prior is below {CLOSE:g}e-4 m^2), so adapted "
        "laws do not start from the law (docs/materials.md, Priors)"
    )
