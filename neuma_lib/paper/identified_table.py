"""Identified materials and the true ones: family, errors of the constants, and coverage of their uncertainty."""

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

from neuma_lib.errors import InputError
from neuma_lib.evaluation.text_tables import as_csv, as_markdown
from neuma_lib.mechanics.combinations import constants_of, named_combinations
from neuma_lib.paper.claims import Verdict, counted, verdict_lines

WITHIN = 2.0  # maximum error in estimated standard deviations
CLOSE = 10.0  # maximum error of a constant that counts as right [%]
SHARE = Fraction(4, 5)
"""Claimed share of right families, of errors within `WITHIN` and of errors within `CLOSE`."""
RIGHT, TIE, WRONG = "right", "tie", "wrong"
MATERIAL, GRID = "of the material", "on the grid"
FITS = {MATERIAL: "material", GRID: "best"}
"""Entries of identified.json with the constants of the material, and with those of the fit's grid and particles."""
COLUMNS = "quantity value truth error_percent log_std error_in_std determined".split()
"""Columns of a quantity in the CSV."""

RULE = (
    "A family is right if it is the one that the truth was simulated with, or ties with it. Constants, moduli and "
    "ratios of the identified family count that the truth has too. Claims count the constants of the material if there "
    "are any, else those on the grid that fit and truth share. *Determined* are those with an estimated standard "
    "deviation below `identify.determined`. A claim *holds* if the count is reached, else it *does "
    "not hold*. Several replicates of a scene are not independent."
)
"""Explanation of the verdicts for readers of the table."""


def true_values(truth: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Constants of a law and their combinations, from its specification."""
    values = constants_of(truth)
    return named_combinations(values) if {"E", "nu"} <= values.keys() else values


def compare_family(identified: Mapping[str, Any], truth: Mapping[str, Mapping[str, Any]]) -> str:
    """`RIGHT`, `TIE` (the right family predicts equally well) or `WRONG`.

    Args:
        identified: content of identified.json.
        truth: specification of the true law.
    """
    if _kind(identified["law"]) == _kind(truth):
        return RIGHT
    return TIE if right_families(identified, truth) & {*identified["ties"]} else WRONG


def right_families(identified: Mapping[str, Any], truth: Mapping[str, Mapping[str, Any]]) -> set[str]:
    """Names of the candidates of the family of the true law. ``identified, truth``: as of `compare_family`."""
    return {name for name, fit in identified["families"].items() if _kind(fit["law"]) == _kind(truth)}


def compare_quantities(
    identified: Mapping[str, Any], truth: Mapping[str, Mapping[str, Any]], of: str = GRID
) -> list[dict]:
    """Quantities that the true law has too, as `COLUMNS`. Values are in SI units and degrees, stds of logarithms.

    Args:
        identified: content of identified.json.
        truth: specification of the true law.
        of: one of `FITS`.
    """
    true, rows = true_values(truth), []
    for name, entry in identified.get(FITS[of], {}).get("quantities", {}).items():
        value, right, std = entry["value"], true.get(name, 0), entry["log_std"]
        if right > 0 and value > 0:
            ratio = value / right
            cells = name, value, right, 100 * (ratio - 1), std, math.log(ratio) / std, entry["determined"]
            rows.append(dict(zip(COLUMNS, cells)))
    return rows


def identified_table(scenes: Sequence[Mapping[str, Any]]) -> tuple[str, str]:
    """CSV with a row for each quantity, and Markdown with a row for each scene and verdicts for each group.

    Args:
        scenes: ``name``, ``group`` of the scenes that claims count together, ``identified``, the content of
            identified.json, and ``truth``, the specification of the true law, for each scene and replicate.

    Raises:
        InputError: there are no scenes.
    """
    if not scenes:
        problem = "no scene has been identified"
        raise InputError("tables.table1", problem, "Name scenes there, or set random.count")
    rows, groups = [], {}
    for scene in scenes:
        identified, laws = scene["identified"], (scene["identified"], scene["truth"])
        verdict, quantities = compare_family(*laws), {of: compare_quantities(*laws, of) for of in FITS}
        for of, compared in quantities.items():
            rows += [[scene["name"], identified["family"], verdict, of, *row.values()] for row in compared]
        tied = f", as good: {', '.join(identified['ties'])}" if identified["ties"] else ""
        counted_of = MATERIAL if FITS[MATERIAL] in identified else GRID
        listed = [_listed(quantities[of], True) for of in FITS] + [_listed(quantities[counted_of], False)]
        cells = [scene["name"], f"{identified['family']} ({verdict}{tied})", *listed]
        groups.setdefault(scene["group"], []).append((cells, verdict, quantities[counted_of]))
    text = [
        "# Identified materials",
        "",
        "Errors of quantities. In brackets: in estimated standard deviations.",
    ]
    verdicts = []
    for group, members in groups.items():
        lines, families, quantities = zip(*members)
        heads = ["scene", "family", *(f"determined, {of}" for of in FITS), "not determined"]
        text += ["", f"**{group}**", "", *as_markdown(heads, lines)]
        verdicts += _verdicts(
            group, families, [row for rows in quantities for row in rows if row["determined"]]
        )
    text += ["", *verdict_lines(verdicts), RULE, ""]
    return as_csv([["scene", "family", "family_is", "constants", *COLUMNS], *rows]), "\n".join(text)


def _kind(spec: Mapping[str, Mapping[str, Any]]) -> tuple[str, str, bool, str, str]:
    """Names of both parts, whether a viscous flow has a yield stress, and names of a viscous part and a field."""
    plasticity = spec.get("plasticity") or {"name": "identity"}
    yields = plasticity["name"] == "viscous_flow" and plasticity.get("yield_stress", 0) > 0
    others = [(spec.get(part) or {"name": ""})["name"] for part in ("viscosity", "field")]
    return spec["elasticity"]["name"], plasticity["name"], yields, *others


def _listed(quantities: Sequence[Mapping], determined: bool) -> str:
    chosen = [q for q in quantities if q["determined"] == determined]
    return ", ".join(
        f"{q['quantity']} {q['error_percent']:+.0f} % ({q['error_in_std']:+.1f})" for q in chosen
    )


def _verdicts(group: str, families: Sequence[str], determined: Sequence[Mapping]) -> list[Verdict]:
    stds, errors = ([abs(row[key]) for row in determined] for key in ("error_in_std", "error_percent"))
    claims = [
        ("the family is right, or ties with the right one,", [family != WRONG for family in families], "scenes", ""),
        (
            f"the truth lies within {WITHIN:g} estimated standard deviations",
            [std <= WITHIN for std in stds],
            "determined quantities",
            f"at most {max(stds, default=0):.1f}",
        ),
        (
            f"the error is below {CLOSE:g} %",
            [error < CLOSE for error in errors],
            "determined quantities",
            f"at most {max(errors, default=0):.0f} %",
        ),
    ]  # fmt: skip
    return [counted(f"{group}: {text} for", met, SHARE, what, numbers) for text, met, what, numbers in claims]
