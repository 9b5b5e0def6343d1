"""Identified materials and the true ones: family, errors of the constants, and coverage of their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from neuma_lib.errors import InputError
from neuma_lib.evaluation.text_tables import as_csv, as_markdown
from neuma_lib.mechanics.combinations import named_combinations
from neuma_lib.paper.claims import Verdict, counted, verdict_lines

WITHIN = 2.0
"""Maximum error in estimated standard deviations."""
CLOSE = 10.0
"""Maximum error of a constant that counts as right [%]."""
SHARE = Fraction(4, 5)
"""Claimed share of right families, of errors within `WITHIN` and of errors within `CLOSE`."""
RIGHT, TIE, WRONG = "right", "tie", "wrong"

RULE = (
    "A family is right if it is the one that the truth was simulated with, or ties with it. Constants, moduli and "
    "ratios of the identified family count that the truth has too; *determined* are those whose standard deviation the "
    "identification gives as less than `identify.determined`. A claim *holds* if the count is reached, else it *does "
    "not hold*; several replicates of a scene are not independent."
)
"""Explanation of the verdicts for readers of the table."""


@dataclass(frozen=True)
class Quantity:
    """A constant or combination.

    Attributes:
        name: as in `named_combinations`.
        value, truth: in SI units and degrees.
        log_std: estimated standard deviation of the logarithm.
        determined: whether the identification counts it as determined.
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
    """Identified material of a scene, in one replicate.

    Attributes:
        name: of the scene's folder.
        group: scenes that claims count together.
        identified: content of identified.json.
        truth: specification of the true law.
    """

    name: str
    group: str
    identified: Mapping[str, Any]
    truth: Mapping[str, Mapping[str, Any]]

    @property
    def family_is(self) -> str:
        """`RIGHT`, `TIE` (the right family predicts equally well) or `WRONG`."""
        true = _kind(self.truth)
        if _kind(self.identified["law"]) == true:
            return RIGHT
        ties = (_kind(self.identified["families"][name]["law"]) for name in self.identified["ties"])
        return TIE if true in ties else WRONG

    @property
    def quantities(self) -> list[Quantity]:
        """Quantities that the true law has too."""
        constants = {
            key: float(value) for part in self.truth.values() for key, value in part.items() if key != "name"
        }
        true = named_combinations(constants)
        return [
            Quantity(name, entry["value"], true[name], entry["log_std"], entry["determined"])
            for name, entry in self.identified["best"]["quantities"].items()
            if true.get(name, 0) > 0 and entry["value"] > 0
        ]


def identified_table(scenes: Sequence[IdentifiedScene]) -> tuple[str, str]:
    """CSV with a row for each quantity, and Markdown with a row for each scene and verdicts for each group.

    Raises:
        InputError: there are no scenes.
    """
    if not scenes:
        raise InputError(
            "tables.table1", "no scene has been identified", "Name scenes there, or set random.count"
        )
    header = (
        "scene family family_is quantity value truth error_percent log_std error_in_std determined".split()
    )
    rows = [
        [
            *(s.name, s.identified["family"], s.family_is),
            *(q.name, q.value, q.truth, q.error, q.log_std, q.in_std, q.determined),
        ]
        for s in scenes
        for q in s.quantities
    ]
    text = [
        "# Identified materials",
        "",
        "Error of each quantity, and in brackets in estimated standard deviations.",
    ]
    verdicts = []
    for group in dict.fromkeys(scene.group for scene in scenes):
        members = [scene for scene in scenes if scene.group == group]
        lines = [[s.name, _family(s), _list(s, True), _list(s, False)] for s in members]
        heads = ["scene", "family", "determined", "not determined"]
        text += ["", f"**{group}**", "", *as_markdown(heads, lines)]
        verdicts += _verdicts(members, group)
    text += ["", *verdict_lines(verdicts), RULE, ""]
    return as_csv([header, *rows]), "\n".join(text)


def _kind(spec: Mapping[str, Mapping[str, Any]]) -> tuple[str, str, bool]:
    """Names of both parts, and whether a viscous flow has a yield stress."""
    plasticity = spec.get("plasticity") or {"name": "identity"}
    yields = plasticity["name"] == "viscous_flow" and plasticity.get("yield_stress", 0) > 0
    return spec["elasticity"]["name"], plasticity["name"], yields


def _family(scene: IdentifiedScene) -> str:
    ties = scene.identified["ties"]
    tied = f", as good: {', '.join(ties)}" if ties else ""
    return f"{scene.identified['family']} ({scene.family_is}{tied})"


def _list(scene: IdentifiedScene, determined: bool) -> str:
    chosen = [q for q in scene.quantities if q.determined == determined]
    return ", ".join(f"{q.name} {q.error:+.0f} % ({q.in_std:+.1f})" for q in chosen)


def _verdicts(scenes: Sequence[IdentifiedScene], group: str) -> list[Verdict]:
    sure = [q for scene in scenes for q in scene.quantities if q.determined]
    stds, errors = [abs(q.in_std) for q in sure], [abs(q.error) for q in sure]
    claims = [
        ("the family is right, or ties with the right one,", [s.family_is != WRONG for s in scenes], "scenes", ""),
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
