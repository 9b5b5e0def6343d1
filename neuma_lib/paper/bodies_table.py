"""Table of the bodies of a scene: errors and constants, identified together and each alone, and frictions."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from neuma_lib.evaluation.text_tables import as_csv, as_markdown
from neuma_lib.mechanics.combinations import constants_of, named_combinations

COLUMNS = ("body", "quantity", "truth", "together", "log_std", "alone", "alone_log_std")
_NOTE = (
    "RMSE [mm] is that of tracers over the video, simulated with all bodies (`true law`, `together`) or without the "
    "others (`alone`). Its first entry is that of the true laws on the same reconstruction. `alone` is identified from "
    "the mask of the body, without the others. Other bodies hide a share of a body, by the identified laws. Standard "
    "deviations are those of the logarithm. Constants are those of the grid."
)


def bodies_table(
    identified: Mapping[str, Any],
    alone: Mapping[str, Mapping[str, Any]],
    truth: Mapping[str, Mapping[str, Any]],
    frictions: Sequence[Mapping[str, Any]],
    errors: Mapping[str, Sequence[float]],
) -> tuple[str, str]:
    """CSV and Markdown.

    Args:
        identified: content of identified.json of all bodies.
        alone: content of identified.json of each body by name.
        truth: specification of the true law of each body by name.
        frictions: true frictions of pairs, as in the settings. None: they stick.
        errors: RMSE of each body [mm] with the true laws, identified together, and alone.
    """
    rows: list[list[Any]] = []
    for name, of_law, together, other in ((name, *values) for name, values in errors.items()):
        rows.append([name, "RMSE [mm]", of_law, together, None, other, None])
        hidden = identified["hidden"][name]
        for kind, share in (("mean", sum(hidden) / len(hidden)), ("last frame", hidden[-1])):
            rows.append([name, f"hidden, {kind} [%]", None, 100 * share, None, None, None])
        records = identified["bodies"][name], alone[name]
        spec = truth[name]
        true_family = "+".join(
            spec[part]["name"]
            for part in ("elasticity", "plasticity")
            if spec.get(part) and spec[part]["name"] != "identity"
        )
        rows.append([name, "family", true_family, records[0]["family"], None, records[1]["family"], None])
        for key, value in named_combinations(constants_of(spec)).items():
            fitted = [record["best"]["quantities"].get(key, {}) for record in records]
            numbers = [number for each in fitted for number in (each.get("value"), each.get("log_std"))]
            rows.append([name, key, value, *numbers])
    true = {frozenset(pair["bodies"]): pair["friction"] for pair in frictions}
    for pair in identified["pairs"]:
        value = true.get(frozenset(pair["bodies"]))
        value = math.inf if value is None else value
        name = " and ".join(pair["bodies"])
        rows.append([name, "friction", value, pair["friction"], pair["log_std"], None, None])
    cells = [[_cell(value) for value in row] for row in rows]
    lines = as_markdown(["Body", "Quantity", "Truth", "Together", "±", "Alone", "±"], cells)
    return as_csv([list(COLUMNS), *rows]), "\n".join([*lines, "", _NOTE, ""])


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return value if isinstance(value, str) else f"{value:.3g}"
