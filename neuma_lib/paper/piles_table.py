"""The benchmark of random scenes of several bodies: a row for each body and each pair, and claims on all."""

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.evaluation.text_tables import as_csv, as_markdown
from neuma_lib.paper.claims import RMSE, counted, verdict_lines
from neuma_lib.paper.identified_table import WRONG, compare_family, compare_quantities

CLOSE = 15.0  # maximum error of a determined constant that counts as right [%]
SLIDES = 0.1
"""Maximum error of a friction that counts as right. It is compared if half the distance to the upper end of its band of
two standard deviations is smaller, since a contact that does not slide does not show it."""
TYPICAL, LARGE = 1.5, 2.5
"""Claimed errors of bodies relative to those of their true laws, in the median and for `LARGE_SHARE`."""
LARGE_SHARE, FAMILY_SHARE, CONSTANTS_SHARE = Fraction(9, 10), Fraction(17, 20), Fraction(4, 5)
COLUMNS = (
    "scene", "body", "hidden_percent", "true_law_mm", "together_mm", "alone_mm", "family", "family_is",
    "alone_family_is", "determined", "determined_within", "error_percent", "truth", "friction", "std",
)  # fmt: skip
_NOTE = (
    "Share of a body that others hide in the last frame. RMSE of tracers over the video, simulated with the true laws "
    "on the same reconstruction, with laws and frictions identified together, and each body alone from its own mask. "
    "Errors of determined constants on the grid, and frictions of pairs with their standard deviation. A friction is "
    f"compared if its band of two standard deviations ends less than {2 * SLIDES:g} above it."
)


def piles_table(scenes: Sequence[Mapping[str, Any]], seed: int, is_development: bool) -> tuple[str, str]:
    """CSV and Markdown.

    Args:
        scenes: each with ``name``, ``bodies``, the specifications of their true laws by name, ``frictions`` of pairs as
            in the settings, ``identified``, a list of the content of identified.json, ``metrics``, the contents of
            metrics.json with the true laws and the identified ones, ``alone`` and ``alone_metrics``, those of
            identified.json and metrics.json of each body, and ``rest``, those of metrics.json of both laws without the
            first body.
        is_development: whether methods are developed on these scenes. There are no verdicts then.

    Raises:
        InputError: there are no scenes.
    """
    if not scenes:
        problem = "there are no random scenes of several bodies"
        raise InputError("random.bodies", problem, "Set random.count too")
    rows, ratios, families, constants, frictions, rest, cost = [], [], [], [], [], [], []
    for scene in scenes:
        (identified,), (true_law, together) = scene["identified"], scene["metrics"]
        bodies = zip(scene["bodies"].items(), scene["alone"], scene["alone_metrics"], strict=True)
        for k, ((name, law), alone, alone_metrics) in enumerate(bodies):
            own = identified["bodies"][name]
            errors = [metrics["bodies"][k][RMSE] for metrics in (true_law, together)] + [alone_metrics[RMSE]]
            known = [row for row in compare_quantities(own, law) if row["determined"]]
            off = [abs(row["error_percent"]) for row in known]
            verdicts = [compare_family(each, law) for each in (own, alone)]
            listed = ", ".join(f"{row['quantity']} {row['error_percent']:+.0f} %" for row in known)
            within = sum(error <= CLOSE for error in off)
            rows.append(
                [
                    scene["name"],
                    name,
                    100 * identified["hidden"][name][-1],
                    *errors,
                    own["family"],
                    *verdicts,
                    len(off),
                    within,
                    listed,
                    *[None] * 3,
                ]
            )
            ratios.append([errors[1] / errors[0], errors[2] / errors[0]])
            families.append([verdict != WRONG for verdict in verdicts])
            constants += [error <= CLOSE for error in off]
        true = {frozenset(pair["bodies"]): pair["friction"] for pair in scene["frictions"]}
        for pair in identified["pairs"]:
            friction = true.get(frozenset(pair["bodies"]))
            right = math.inf if friction is None else friction
            std = pair["friction"] * pair["log_std"]
            rows.append(
                [scene["name"], " and ".join(pair["bodies"]), *[None] * 10, right, pair["friction"], std]
            )
            if pair["friction"] * math.expm1(2 * pair["log_std"]) / 2 < SLIDES:
                frictions.append(abs(pair["friction"] - right) <= SLIDES)
        rest.append(scene["rest"][1][RMSE] / scene["rest"][0][RMSE])
        single = [alone["rollouts"] for alone in scene["alone"]]
        cost.append([len(single) * identified["rollouts"] / n for n in (sum(single), np.mean(single))])
    ratio, family = np.array(ratios), np.array(families)
    medians = np.median(ratio, axis=0)
    numbers = f"median {medians[0]:.2f}, alone {medians[1]:.2f}"
    error = "the RMSE is at most {:g} times that of the true law for"
    claims = [
        counted(error.format(TYPICAL), ratio[:, 0] <= TYPICAL, Fraction(1, 2), "bodies", numbers),
        counted(
            error.format(LARGE),
            ratio[:, 0] <= LARGE,
            LARGE_SHARE,
            "bodies",
            f"at most {ratio[:, 0].max():.2f}",
        ),
        counted(
            "the family is right, or ties with the right one, for",
            family[:, 0],
            FAMILY_SHARE,
            "bodies",
            f"alone {family[:, 1].sum()}",
        ),
        counted(f"the error is at most {CLOSE:g} % for", constants, CONSTANTS_SHARE, "determined constants"),
        counted(f"the friction is within {SLIDES:g} for", frictions, 1, "pairs that show it", whole="all"),
        counted(
            f"without the first body the RMSE is at most {TYPICAL:g} times that of the true laws in",
            [each <= TYPICAL for each in rest],
            1,
            "scenes",
            f"median {np.median(rest):.2f}, at most {max(rest):.2f}",
            whole="all",
        ),
        counted(
            "the simulations of bodies are at most a tenth of those of all bodies alone, or twice those of one, in",
            [by_all <= 0.1 or by_one <= 2 for by_all, by_one in cost],
            1,
            "scenes",
            f"median {np.median(np.array(cost)[:, 1]):.1f} times those of one",
            whole="all",
        ),
    ]
    use = "Methods are developed on these scenes: results are not reported. " if is_development else ""
    heads = [column.replace("_", " ") for column in COLUMNS]
    cells = [["" if v is None else v if isinstance(v, str) else f"{v:.3g}" for v in row] for row in rows]
    text = [
        f"# Random scenes of several bodies, seed {seed}",
        "",
        f"{use}{_NOTE}",
        "",
        *(
            [f"- {claim.text}: {claim.here}." for claim in claims]
            if is_development
            else verdict_lines(claims)
        ),
        "",
        *as_markdown(heads, cells),
        "",
    ]
    return as_csv([list(COLUMNS), *rows]), "\n".join(text)
