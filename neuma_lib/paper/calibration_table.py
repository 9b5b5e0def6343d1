"""Coverage and scores of intervals of constants and predicted motions, and of probabilities of families."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.evaluation.calibration import (
    GRID,
    LEVELS,
    MATERIAL,
    MOTION,
    NORMAL,
    family_probabilities,
    quantiles_of,
    stored,
)
from neuma_lib.evaluation.coverage import Intervals, brier_score, mean_over_scenes
from neuma_lib.evaluation.text_tables import as_csv, as_markdown
from neuma_lib.fitting.families import FRICTION
from neuma_lib.paper.claims import FAILS, HOLDS, MIXED, Verdict, verdict_lines
from neuma_lib.paper.identified_table import WITHIN

TARGETS = {0.5: (0.45, 0.55), 0.8: (0.75, 0.85), 0.95: (0.92, 0.98)}
"""Level of intervals -> range of the share of truths that they should contain."""
BAND = 0.1  # half width of the fixed band: of a constant, or of the distance of a point from its start
CALIBRATED, LAPLACE, FIXED = "calibrated", "Laplace", f"fixed {100 * BAND:.0f} %"
METHODS = (CALIBRATED, LAPLACE, FIXED)
CONSTANTS, LAUNCH, SHAPE, FAMILY = "constants", "another launch", "another shape", "family"
MOTIONS = {"launch": LAUNCH, "shape": SHAPE}
UNITS = {CONSTANTS: "%", FRICTION: "%", LAUNCH: "mm", SHAPE: "mm", FAMILY: ""}
"""Units of widths and scores: percent of a constant as 100 times a logarithm, millimetres of a coordinate."""
COLUMNS = (
    "quantity", "group", "method", "level", "scenes", "values", "covered", "covered_low", "covered_high", "score",
    "score_low", "score_high", "width",
)  # fmt: skip
ALL = "all"
RULE = (
    "Coverage is the share of truths inside the intervals, score the mean interval score (Gneiting and Raftery 2007), "
    "lower is better, and [ ] the 95 % confidence interval of a bootstrap over the scenes. Constants count in "
    "logarithms, motions by coordinate of a point after the first contact. The Laplace approximation takes pixels as "
    "independent. The fixed band is the same at all levels. A claim *holds* if the coverage is in the range, is "
    "*mixed* if only its confidence interval reaches the range, else it *does not hold*."
)
"""Explanation for readers of the table."""
_TINY = 1e-9  # standard deviations of a prediction are at least this [m], which is round-off


def kind(scene: Mapping[str, Any]) -> str:
    """Whether a scene is compared with the constants of the material or those on the grid."""
    return MATERIAL if scene["converged"] else GRID


def errors_in_std(scene: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Errors of a scene in estimated standard deviations, by calibrated quantity."""
    constants = [math.log(row["value"] / row["truth"]) / row["log_std"] for row in scene["constants"]]
    motions = [
        ((_array(motion, "value") - _array(motion, "truth")) / _std(motion, "std")).ravel()
        for motion in scene["motions"].values()
    ]
    return {kind(scene): np.array(constants), MOTION[kind(scene)]: np.concatenate([np.zeros(0), *motions])}


def intervals_of(scene: Mapping[str, Any], quantity: str, method: str, level: float) -> Intervals | None:
    """Intervals of a scene: of logarithms of constants times 100, or of coordinates [mm]. None if it has none.

    Args:
        quantity: `CONSTANTS`, `FRICTION`, `LAUNCH` or `SHAPE`.
        method: one of `METHODS`.
    """
    if quantity in MOTIONS.values():
        return _motion_intervals(scene, quantity, method, level)
    rows = [row for row in scene["constants"] if (row["name"] == FRICTION) == (quantity == FRICTION)]
    if not rows:
        return None
    value, truth = (100 * np.log([row[key] for row in rows]) for key in ("value", "truth"))
    if method == FIXED:
        low, high = 100 * math.log(1 - BAND), 100 * math.log(1 + BAND)
        return Intervals(value + low, value + high, truth)
    std = 100 * np.array([row["log_std" if method == CALIBRATED else "laplace_log_std"] for row in rows])
    reach = _quantile(kind(scene), method, level) * std
    return Intervals(value - reach, value + reach, truth)


def _motion_intervals(scene: Mapping[str, Any], quantity: str, method: str, level: float) -> Intervals | None:
    motions = {MOTIONS[key]: motion for key, motion in scene["motions"].items()}
    if quantity not in motions:
        return None
    motion = motions[quantity]
    value, truth = _array(motion, "value"), _array(motion, "truth")
    if method == FIXED:
        moved = np.linalg.norm(value - np.array(motion["start_mm"]), axis=-1, keepdims=True)
        reach = np.broadcast_to(BAND * moved, value.shape)
    else:
        std = _std(motion, "std" if method == CALIBRATED else "laplace_std")
        reach = _quantile(MOTION[kind(scene)], method, level) * std
    return Intervals(value - reach, value + reach, truth)


def _quantile(quantity: str, method: str, level: float) -> float:
    return (quantiles_of(quantity) if method == CALIBRATED else NORMAL).at(level)


def _array(motion: Mapping[str, Any], name: str) -> np.ndarray:
    return np.array(motion[f"{name}_mm"])


def _std(motion: Mapping[str, Any], name: str) -> np.ndarray:
    return np.maximum(_array(motion, name), 1e3 * _TINY)


def groups_of(scenes: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """All scenes, and those of each kind of truth."""
    groups: dict[str, list[Mapping[str, Any]]] = {ALL: list(scenes)}
    for scene in scenes:
        family = "of a candidate" if scene["families"] else "outside the candidates"
        truth = "converged" if scene["converged"] else "same grid"
        groups.setdefault(f"{family}, {truth}", []).append(scene)
    return {name: groups[name] for name in sorted(groups, key=lambda name: (name != ALL, name))}


def coverage(
    scenes: Sequence[Mapping[str, Any]], quantity: str, method: str, level: float
) -> dict[str, Any] | None:
    """Coverage, score and mean width over scenes with their confidence. None without intervals."""
    known = [each for scene in scenes if (each := intervals_of(scene, quantity, method, level)) is not None]
    if not known:
        return None
    covered = mean_over_scenes([each.covered for each in known])
    score = mean_over_scenes([each.score(level) for each in known])
    values = sum(each.truth.size for each in known)
    width = sum(float(each.width.sum()) for each in known) / values
    ends = ("", "_low", "_high")
    return {
        "scenes": len(known),
        "values": values,
        **{f"covered{end}": value for end, value in zip(ends, covered, strict=True)},
        **{f"score{end}": value for end, value in zip(ends, score, strict=True)},
        "width": width,
    }


FAMILY_METHODS: dict[str, Callable[[Mapping[str, Any]], Mapping[str, float]]] = {
    CALIBRATED: family_probabilities,
    "selected family": lambda known: {known["selected"]: 1.0},
    "equal": lambda known: dict.fromkeys(known["compared"], 1 / len(known["compared"])),
}
"""Probabilities of families that are compared: those from scores, all for the selected one, and equal ones."""


def brier(scenes: Sequence[Mapping[str, Any]], method: str) -> dict[str, Any] | None:
    """Mean Brier score over scenes whose truth is a candidate. None if there are none."""
    known = [scene["families"] for scene in scenes if scene["families"]]
    if not known:
        return None
    scores = [np.array(brier_score(FAMILY_METHODS[method](each), {*each["right"]})) for each in known]
    mean, low, high = mean_over_scenes(scores)
    return {"scenes": len(known), "values": len(known), "score": mean, "score_low": low, "score_high": high}


def table_rows(scenes: Sequence[Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
    """Rows with `COLUMNS`."""
    for group, own in groups_of(scenes).items():
        for quantity in (CONSTANTS, FRICTION, *MOTIONS.values()):
            for method in METHODS:
                for level in TARGETS:
                    if measured := coverage(own, quantity, method, level):
                        yield {
                            "quantity": quantity,
                            "group": group,
                            "method": method,
                            "level": level,
                            **measured,
                        }
        for method in FAMILY_METHODS:
            if measured := brier(own, method):
                yield {"quantity": FAMILY, "group": group, "method": method, "level": "", **measured}


def calibration_table(
    scenes: Sequence[Mapping[str, Any]], is_development: bool, determined: float
) -> tuple[str, str]:
    """CSV with a row for each quantity, kind of truth, method and level, and Markdown with verdicts.

    Args:
        scenes: contents of calibration.json of scenes: ``name``, ``converged``, ``constants`` (`calibration_record`),
            ``at_least`` (lower bound of the friction and the truth, or None), ``families``  and
            ``motions`` with ``value_mm``, ``truth_mm``, ``std_mm``, ``laplace_std_mm`` (T, M, 3) and ``start_mm``
            (M, 3) by name.
        is_development: whether quantiles are measured on these scenes. There are no verdicts then.
        determined: maximum standard deviation of the logarithm of a determined constant.

    Raises:
        InputError: there are no scenes.
    """
    if not scenes:
        raise InputError("random.count", "there are no random scenes", "Set it to a positive number")
    rows = list(table_rows(scenes))
    text = ["# Calibration", "", _source(), ""]
    if is_development:
        text += ["These scenes are for development: their results are not reported.", ""]
    for quantity in UNITS:
        own = [row for row in rows if row["quantity"] == quantity]
        if own and quantity != FAMILY:
            text += [
                f"**Intervals: {quantity.replace('_', ' ')}**",
                "",
                *_intervals(own, UNITS[quantity]),
                "",
            ]
    text += _families(scenes, rows)
    text += _determined(scenes, determined)
    text += _left_out(scenes)
    text += [] if is_development else verdict_lines(_verdicts(rows))
    text += [RULE, ""]
    cells = [[_number(row.get(key, "")) for key in COLUMNS] for row in rows]
    return as_csv([COLUMNS, *cells]), "\n".join(text)


def _source() -> str:
    if not stored():
        return "Nothing has been calibrated: intervals are normal, and the temperature of probabilities is 1."
    source, counts = stored()["source"], stored()["counts"]
    numbers = ", ".join(f"{name}: {each['scenes']} scenes" for name, each in counts.items())
    seeds = ", ".join(map(str, source["seeds"]))
    return f"Quantiles and temperature were measured on scenes of the development seeds {seeds} ({numbers})."


def _intervals(rows: Sequence[Mapping[str, Any]], unit: str) -> list[str]:
    head = ["group", "scenes", "method"]
    for level in TARGETS:
        head += [f"{100 * level:.0f} %: covered", f"score ({unit})", f"width ({unit})"]
    lines: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        line = lines.setdefault((row["group"], row["method"]), [row["group"], row["scenes"], row["method"]])
        covered = (
            f"{100 * row['covered']:.0f} % [{100 * row['covered_low']:.0f}, {100 * row['covered_high']:.0f}]"
        )
        score = f"{row['score']:.3g} [{row['score_low']:.3g}, {row['score_high']:.3g}]"
        line += [covered, score, f"{row['width']:.3g}"]
    return as_markdown(head, lines.values())


def _families(scenes: Sequence[Mapping[str, Any]], rows: Sequence[Mapping[str, Any]]) -> list[str]:
    own = [row for row in rows if row["quantity"] == FAMILY and row["group"] == ALL]
    if not own:
        return []
    cells = [
        [
            row["method"],
            row["scenes"],
            f"{row['score']:.3f} [{row['score_low']:.3f}, {row['score_high']:.3f}]",
        ]
        for row in own
    ]
    known = [scene["families"] for scene in scenes if scene["families"]]
    bins = []
    for low, high in ((0.0, 0.5), (0.5, 0.8), (0.8, 0.95), (0.95, 1.0)):
        inside = [
            (p, name in each["right"])
            for each in known
            for name, p in family_probabilities(each).items()
            if low < p <= high
        ]
        if inside:
            mean, share = (100 * float(np.mean(values)) for values in zip(*inside, strict=True))
            bins.append([f"{low:g} to {high:g}", len(inside), f"{mean:.0f} %", f"{share:.0f} %"])
    return [
        "**Probabilities of families**, of scenes whose truth is a candidate",
        "",
        *as_markdown(["probabilities", "scenes", "Brier score"], cells),
        "",
        *as_markdown(
            ["probability of a family", "families", "mean probability", "share that is right"], bins
        ),
        "",
    ]


def _determined(scenes: Sequence[Mapping[str, Any]], below: float) -> list[str]:
    """Table of the constants with an estimated standard deviation below a limit."""
    lines = []
    for group, own in groups_of(scenes).items():
        known = [scene["families"] for scene in own if scene["families"]]
        right = f"{sum(each['selected'] in each['right'] for each in known)} of {len(known)}" if known else ""
        rows = [row for scene in own for row in scene["constants"] if row["name"] != FRICTION]
        logs = [(math.log(row["value"] / row["truth"]), row["log_std"]) for row in rows]
        errors = [(math.expm1(error), error / std) for error, std in logs if std < below]
        close = sum(abs(error) <= BAND for error, _ in errors)
        near = sum(abs(z) <= WITHIN for _, z in errors)
        lines.append([group, len(own), right, f"{len(errors)} of {len(rows)}", close, near])
    head = [
        "group",
        "scenes",
        "family right",
        "determined",
        f"within {100 * BAND:.0f} %",
        f"within {WITHIN:.0f} std",
    ]
    title = f"**Determined constants**, with an estimated standard deviation below {100 * below:.0f} %"
    return [title, "", *as_markdown(head, lines), ""]


def _left_out(scenes: Sequence[Mapping[str, Any]]) -> list[str]:
    """Lines on scenes without constants or motions, and on lower bounds of the friction."""
    lines = []
    empty = [scene["name"] for scene in scenes if not scene["constants"]]
    if empty:
        lines.append(f"- Without constants to compare: {', '.join(empty)}.")
    for key, quantity in MOTIONS.items():
        missing = [f"{scene['name']} ({scene['failed'][key]})" for scene in scenes if key in scene["failed"]]
        if missing:
            lines.append(f"- Without a prediction of {quantity}: {', '.join(missing)}.")
    bounds = [scene["at_least"] for scene in scenes if scene["at_least"]]
    if bounds:
        met = sum(bound <= truth for bound, truth in bounds)
        lines.append(
            f"- Lower bound of the friction instead of an interval: {len(bounds)} scenes, {met} below the truth."
        )
    return [*lines, ""] if lines else []


def _verdicts(rows: Sequence[Mapping[str, Any]]) -> list[Verdict]:
    """Whether calibrated intervals of all scenes contain the shares of `TARGETS`."""
    verdicts = []
    for row in rows:
        if row["group"] != ALL or row["method"] != CALIBRATED or row["quantity"] == FAMILY:
            continue
        low, high = TARGETS[row["level"]]
        inside = low <= row["covered"] <= high
        near = row["covered_low"] <= high and row["covered_high"] >= low
        text = (
            f"{row['quantity'].replace('_', ' ')}: {100 * row['level']:.0f} % intervals contain {100 * low:.0f} to "
            f"{100 * high:.0f} % of the truths"
        )
        here = (
            f"{100 * row['covered']:.0f} % [{100 * row['covered_low']:.0f}, {100 * row['covered_high']:.0f}] of "
            f"{row['values']} values in {row['scenes']} scenes"
        )
        verdicts.append(Verdict(text, HOLDS if inside else MIXED if near else FAILS, here))
    return verdicts


def reliability(scenes: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, list[float]]]]:
    """Coverage with its confidence at `LEVELS` by quantity and method, for a reliability diagram."""
    curves: dict[str, dict[str, dict[str, list[float]]]] = {}
    for quantity in (CONSTANTS, FRICTION, *MOTIONS.values()):
        for method in METHODS:
            points = [coverage(scenes, quantity, method, level) for level in LEVELS]
            if points[0]:
                keys = ("covered", "covered_low", "covered_high")
                own = {key: [point[key] for point in points] for key in keys}
                curves.setdefault(quantity, {})[method] = own
    return curves


def _number(value: Any) -> Any:
    return f"{value:.5g}" if isinstance(value, float) else value
