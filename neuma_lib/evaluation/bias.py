"""Bias of the pixels: the loss that the true law has on a reconstruction, beside the loss of a method's law.

A right law on a right reconstruction would have the lowest loss. Where a wrong one has a lower loss than the truth, the
images hold errors of the reconstruction (texture, kernels, start, how Gaussians stretch) that the law has absorbed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import fmean

import torch

from neuma_lib.evaluation.motion import Failure, predict
from neuma_lib.evaluation.reports import as_csv, as_markdown
from neuma_lib.evaluation.tables import JUDGED, TRUE_LAW
from neuma_lib.fitting.material import TrajectoryLoss
from neuma_lib.mechanics.law import Law
from neuma_lib.sim.model import MPMModel
from neuma_lib.sim.state import State

ABSORBS_BELOW = 0.8
"""Ratio of losses below which a law that is no closer to the true motion has absorbed errors of the reconstruction."""

COLUMNS = {
    "scene": "Scene",
    "method": "Method",
    "loss_true_law": "Loss of the true law",
    "loss": "Loss of the method's law",
    "ratio": "Ratio",
    JUDGED: "Tracer RMSE (mm)",
}
"""Keys of a line of the table, and their headings."""


def frame_losses(
    model: MPMModel, law: Law, start: State, loss: TrajectoryLoss
) -> tuple[list[float], Failure | None]:
    """Training losses of the frames under any law, unweighted, and how its motion failed (None: it did not).

    Frames after a failure count as held at the last sound one.
    """
    with torch.no_grad():
        path, failure = predict(model, law, start, loss.steps, total=loss.total)
        return loss(path).tolist(), failure


def bias_report(losses: Sequence[float], true_losses: Sequence[float]) -> dict[str, object]:
    """Mean losses of a method's law and of the true law, their ratio, and both frame by frame."""
    loss, truth = fmean(losses), fmean(true_losses)
    return {
        "loss": loss,
        "loss_true_law": truth,
        "ratio": loss / truth,
        "loss_per_frame": list(losses),
        "loss_true_law_per_frame": list(true_losses),
    }


def bias_table(rows: Sequence[Mapping], titles: Mapping[str, str]) -> tuple[str, str, str]:
    """Losses of methods on scenes beside those of the true law.

    Args:
        rows: one run each, with the keys of `COLUMNS`.
        titles: method -> name in the Markdown table.

    Returns:
        CSV, Markdown, and a sentence on the laws that have absorbed errors of the reconstruction; it is empty where no
        run of `TRUE_LAW` tells the error that a right law has.
    """
    csv = as_csv([list(COLUMNS), *([row[key] for key in COLUMNS] for row in rows)])
    cells = [
        [
            row["scene"],
            titles[row["method"]],
            *(f"{row[key]:.3e}" for key in ("loss_true_law", "loss")),
            f"{row['ratio']:.2f}",
            f"{row[JUDGED]:.2f}",
        ]
        for row in rows
    ]
    allowed = {row["scene"]: row[JUDGED] for row in rows if row["method"] == TRUE_LAW}
    learned = [row for row in rows if row["method"] != TRUE_LAW and row["scene"] in allowed]
    absorbed = [
        f"{titles[row['method']]} on {row['scene']} ({row['ratio']:.2f})"
        for row in learned
        if row["ratio"] < ABSORBS_BELOW and row[JUDGED] >= allowed[row["scene"]]
    ]
    sentence = ""
    if learned:
        sentence = (
            f"In {len(absorbed)} of {len(learned)} runs a law has less than {ABSORBS_BELOW:g} of the true law's loss "
            f"without being closer to the true motion than it{': ' if absorbed else ''}{', '.join(absorbed)}."
        )
    note = "Losses are the mean squared colour differences of the training views, with equal weights of all frames."
    text = [*as_markdown(list(COLUMNS.values()), cells), "", note, "", *([sentence, ""] if sentence else [])]
    return csv, "\n".join(text), sentence
