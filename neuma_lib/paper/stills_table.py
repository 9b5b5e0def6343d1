"""Table of stiffness over density of bodies at rest, one row for each clamp."""

from collections.abc import Mapping
from typing import Any

from neuma_lib.evaluation.text_tables import as_csv, as_markdown

COLUMNS = {
    "ratio": "μ/ρ [m²/s²]",
    "log_std": "± [%]",
    "noise_std": "noise, placement [%]",
    "stills_std": "between stills [%]",
    "mesh_std": "mesh [%]",
    "clamp_std": "clamp [%]",
    "contour_rms": "contour [px]",
    "iou": "IoU",
}
_NOTE = (
    "μ/ρ is extrapolated from two meshes. Standard deviations are those of its logarithm. Rows `all clamps` have the "
    "mean over the clamps and half of their distance as a standard deviation. In rows with `predicted`, μ/ρ is given, "
    "and the silhouette determines pose and placement only."
)


def stills_table(results: Mapping[str, Mapping[str, Any]]) -> tuple[str, str]:
    """CSV and Markdown. ``results``: title of a body -> result of `fit_record` or `predict_record`."""
    rows = []
    for title, result in results.items():
        predicted = " (predicted)" if result.get("predicted_from") else ""
        for clamp, values in result["clamps"].items():
            rows.append([title + predicted, clamp, *(values.get(key) for key in COLUMNS)])
        if "log_std" in result:
            rows.append([title, "all clamps", *(result.get(key) for key in COLUMNS)])
    cells = [[*row[:2], *map(_cell, COLUMNS, row[2:])] for row in rows]
    lines = as_markdown(["Body", "Clamp", *COLUMNS.values()], cells)
    return as_csv([["body", "clamp", *COLUMNS], *rows]), "\n".join([*lines, "", _NOTE, ""])


def _cell(key: str, value: float | None) -> str:
    if value is None:
        return ""
    if key.endswith("_std"):
        return f"{100 * value:.1f}"
    return f"{value:.3f}" if key == "iou" else f"{value:.1f}" if key == "ratio" else f"{value:.2f}"
