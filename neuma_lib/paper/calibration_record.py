"""Identified constants, families and motions of a scene next to the truth, from which coverage is measured.

The record does not depend on the calibration, so that another calibration repeats no simulation.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import Tensor

from neuma_lib.evaluation.motion_spread import MotionSpread
from neuma_lib.fitting.families import FRICTION
from neuma_lib.paper.identified_table import FITS, GRID, MATERIAL, right_families, true_values


def constants_with_truths(
    identified: Mapping[str, Any],
    truth: Mapping[str, Mapping[str, Any]],
    friction: float | None,
    converged: bool,
) -> list[dict[str, Any]]:
    """Constants that the true law has too: ``name``, ``value``, ``truth``, ``log_std`` and ``laplace_log_std``.

    Args:
        identified: content of identified.json.
        truth: specification of the true law.
        friction: true Coulomb coefficient. None: it was given.
        converged: whether the truth is, so that it is compared with the constants of the material.
    """
    fit = identified.get(FITS[MATERIAL if converged else GRID], {})
    true = true_values(truth) | ({} if friction is None else {FRICTION: friction})
    if "at_least" in identified.get(FRICTION, {}):
        true.pop(FRICTION, None)
    rows = []
    for name, entry in fit.get("quantities", {}).items():
        if true.get(name, 0) > 0 and entry["value"] > 0:
            kept = {key: entry[key] for key in ("value", "log_std", "laplace_log_std")}
            rows.append({"name": name, "truth": true[name], **kept})
    return rows


def families_with_truth(
    identified: Mapping[str, Any], truth: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any] | None:
    """Scores of the compared families, and names of the true one. None: the truth is no candidate."""
    right = right_families(identified, truth)
    if not right:
        return None
    scores = {name: {"score": identified["families"][name]["score"]} for name in identified["compared"]}
    return {
        "families": scores,
        "compared": list(scores),
        "selected": identified["family"],
        "right": sorted(right),
    }


def motion_with_truth(motion: MotionSpread, truth: Tensor) -> dict[str, Any]:
    """Predicted and true positions in millimetres: ``start_mm`` (M, 3), and ``value_mm``, ``std_mm``,
    ``laplace_std_mm`` and ``truth_mm`` (T, M, 3); ``failed``, the number of sampled laws that did.

    Args:
        truth: true positions of the points at the frames of the prediction [m].
    """
    arrays = {
        "start_mm": motion.points,
        "value_mm": motion.value,
        "std_mm": motion.std,
        "laplace_std_mm": motion.laplace_std,
        "truth_mm": truth,
    }
    plain = {name: np.round(1e3 * values.double().numpy(), 4).tolist() for name, values in arrays.items()}
    return {"failed": motion.failed, **plain}
