"""Identified materials beside the true ones: family, errors of the constants, and how honest their uncertainty is."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from neuma_lib.errors import InputError
from neuma_lib.evaluation.text_tables import as_csv, as_markdown
from neuma_lib.mechanics.combinations import named_combinations
from neuma_lib.paper.tables import FAILS, HOLDS, VERDICTS

WITHIN = 2.0
"""Standard deviations that an error may have."""
CLOSE = 10.0
"""Percent within which a constant counts as right."""
ASKED = Fraction(4, 5)
"""Least part of families, of errors within `WITHIN` and of errors within `CLOSE` that is claimed."""
RIGHT, TIE, WRONG = "right", "tie", "wrong"

RULE = (
    "A family is right if it is the one that the truth was simulated with, or ties with it. Constants, moduli and "
    "ratios of the found family count that the truth has too; *determined* are those whose standard deviation the "
    "identification gives as less than `identify.determined`. A claim *holds* if the count is reached, else it *does "
    "not hold*; several chains of a scene are not independent."
)
"""How the verdicts come about, for people."""


@dataclass(frozen=True)
class Quantity:
    """A constant or combination.

    Attributes:
        name: as in `named_combinations`.
        value, truth: in SI units and degrees.
        log_std: estimated standard deviation of the logarithm.
        determined: whether the identification says so.
    """

    name: str
    value: float
    truth: float
    log_std: float
    determined: bool

    @property
    def error(self) -> float:
        """Relative error [%]."""
        return 100 * (self.value / self.truth - 1)

    @property
    def in_std(self) -> float:
        """Error of the logarithm in estimated standard deviations."""
        return math.log(self.value / self.truth) / self.log_std


@dataclass(frozen=True)
class IdentifiedScene:
    """What was found in a scene, in a chain.

    Attributes:
        name: of the scene's folder.
        group: what it is counted with.
        found: content of identified.json.
        truth: specification of the true law.
    """

    name: str
    group: str
    found: Mapping[str, Any]
    truth: Mapping[str, Mapping[str, Any]]

    @property
    def family_is(self) -> str:
        """`RIGHT`, `TIE` (the right one predicts as well) or `WRONG`."""
        true = _kind(self.truth)
        if _kind(self.found["law"]) == true:
            return RIGHT
        ties = (_kind(self.found["families"][name]["law"]) for name in self.found["ties"])
        return TIE if true in ties else WRONG

    @property
    def quantities(self) -> list[Quantity]:
        """Those that the true law has too."""
        constants = {
            key: float(value) for part in self.truth.values() for key, value in part.items() if key != "name"
        }
        true = named_combinations(constants)
        return [
            Quantity(name, entry["value"], true[name], entry["log_std"], entry["determined"])
            for name, entry in self.found["best"]["quantities"].items()
            if true.get(name, 0) > 0 and entry["value"] > 0
        ]


def identified_table(scenes: Sequence[IdentifiedScene]) -> tuple[str, str]:
    """CSV, a quantity a row, and Markdown, a scene a row, with verdicts for each group.

    Raises:
        InputError: there are no scenes.
    """
    if not scenes:
        raise InputError(
            "identified: there is nothing identified, name scenes in tables.table1 or set random.count"
        )
    header = (
        "scene family family_is quantity value truth error_percent log_std error_in_std determined".split()
    )
    rows = [
        [
            s.name,
            s.found["family"],
            s.family_is,
            q.name,
            q.value,
            q.truth,
            q.error,
            q.log_std,
            q.in_std,
            q.determined,
        ]
        for s in scenes
        for q in s.quantities
    ]
    text = [
        "# Identified materials",
        "",
        "Error of each quantity, and in brackets in estimated standard deviations.",
    ]
    for group in dict.fromkeys(scene.group for scene in scenes):
        members = [scene for scene in scenes if scene.group == group]
        lines = [[s.name, _said(s), _listed(s, True), _listed(s, False)] for s in members]
        heads = ["scene", "family", "determined", "not determined"]
        text += ["", f"**{group}**", "", *as_markdown(heads, lines)]
    verdicts = [row for group in dict.fromkeys(s.group for s in scenes) for row in _verdicts(scenes, group)]
    text += ["", "**What holds**", "", *as_markdown([*VERDICTS[:2], "here"], verdicts), "", RULE, ""]
    return as_csv([header, *rows]), "\n".join(text)


def _kind(spec: Mapping[str, Mapping[str, Any]]) -> tuple[str, str, bool]:
    """Names of both parts, and whether a viscous flow has a yield stress."""
    plasticity = spec.get("plasticity") or {"name": "identity"}
    yields = plasticity["name"] == "viscous_flow" and plasticity.get("yield_stress", 0) > 0
    return spec["elasticity"]["name"], plasticity["name"], yields


def _said(scene: IdentifiedScene) -> str:
    tied = f", as good: {', '.join(scene.found['ties'])}" if scene.found["ties"] else ""
    return f"{scene.found['family']} ({scene.family_is}{tied})"


def _listed(scene: IdentifiedScene, determined: bool) -> str:
    parts = [
        f"{q.name} {q.error:+.0f} % ({q.in_std:+.1f})" for q in scene.quantities if q.determined == determined
    ]
    return ", ".join(parts)


def _verdicts(scenes: Sequence[IdentifiedScene], group: str) -> list[list[str]]:
    members = [scene for scene in scenes if scene.group == group]
    sure = [q for scene in members for q in scene.quantities if q.determined]
    claims = [
        ("the family is right, or ties with the right one,", [s.family_is != WRONG for s in members], "scenes", ""),
        (
            f"the truth lies within {WITHIN:g} estimated standard deviations",
            [abs(q.in_std) <= WITHIN for q in sure],
            "determined quantities",
            f"at most {max((abs(q.in_std) for q in sure), default=0):.1f}",
        ),
        (
            f"the error is below {CLOSE:g} %",
            [abs(q.error) < CLOSE for q in sure],
            "determined quantities",
            f"at most {max((abs(q.error) for q in sure), default=0):.0f} %",
        ),
    ]  # fmt: skip
    rows = []
    for text, met, what, numbers in claims:
        least, count = math.ceil(ASKED * len(met)), sum(met)
        here = ", ".join(filter(None, [f"{count} of {len(met)}", numbers]))
        word = HOLDS if met and count >= least else FAILS
        rows.append([f"{group}: {text} for at least {least} of {len(met)} {what}", f"**{word}**", here])
    return rows
