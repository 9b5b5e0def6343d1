"""Tables of the paper from metrics: CSV for programs, Markdown for people."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from neuma_lib.errors import InputError

PAPER_SCENES = ("BouncyBall", "JellyDuck", "RubberPawn", "ClayCat", "SandFish", "HoneyBottle")
PAPER_TABLE1 = {
    "pac_nerf": (516.30, 137.73, 15.47, 15.38, 1.71, 2.21),
    "nclaw": (56.13, 6.32, 3.31, 2.45, 2.61, 2.26),
    "neuma": (1.19, 3.03, 1.27, 1.00, 0.65, 0.73),
    "neuma_particle_supervision": (1.45, 3.74, 1.25, 1.00, 0.80, 0.84),
    "neuma_without_binding": (3.34, 28.42, 4.62, 1.26, 0.97, 1.01),
    "neuma_without_adaptor": (1.87, 3.63, 1.42, 1.36, 1.21, 1.23),
}
"""Chamfer distances of the paper's Table 1, columns as `PAPER_SCENES`; they contain its sampling floor."""

QUANTITIES = {
    "chamfer": "Chamfer distance (1e-4 m², mean over the sequence)",
    "chamfer_excess": "Excess over the sampling floor (1e-4 m²)",
    "tracer_rmse_mm": "Tracer RMSE from identical start points (mm)",
}
"""What Table 1 shows of each run, by its name in metrics.json."""

TRAINING_DIVERGED, ROLLOUT_DIVERGED = "†", "‡"
FOOTNOTES = {
    TRAINING_DIVERGED: "The training diverged; its last good state is shown.",
    ROLLOUT_DIVERGED: "The predicted motion became non-finite; later frames hold the last finite state.",
}
"""Signs behind numbers, and what they mean."""


@dataclass
class Table:
    """Numbers with row and column names; the last column is the average.

    Attributes:
        columns: column names without the average.
        rows: (quantity, method, title, one value a column) each.
        marks: (method, column) -> signs of `FOOTNOTES`, for runs that diverged.
    """

    columns: tuple[str, ...]
    rows: list[tuple[str, str, str, tuple[float, ...]]] = field(default_factory=list)
    marks: dict[tuple[str, str], str] = field(default_factory=dict)

    def values(self, quantity: str, method: str) -> dict[str, float]:
        """One row as a dict, with "Average"."""
        for q, m, _, values in self.rows:
            if (q, m) == (quantity, method):
                return dict(zip([*self.columns, "Average"], _with_average(values), strict=True))
        raise InputError(f"table: no row {quantity} of {method}")

    def csv(self) -> str:
        """Comma-separated values: quantity, method, title, one column a scene, Average, diverged."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["quantity", "method", "title", *self.columns, "Average", "diverged"])
        for quantity, method, title, values in self.rows:
            diverged = [c for c in self.columns if (method, c) in self.marks]
            cells = [f"{v:.4f}" for v in _with_average(values)]
            writer.writerow([quantity, method, title, *cells, " ".join(diverged)])
        return out.getvalue()

    def markdown(self) -> str:
        """One Markdown table a quantity; the paper's numbers stand below the Chamfer distances."""
        parts = ["# Table 1: dynamics grounding", ""]
        for quantity, heading in QUANTITIES.items():
            rows = [row for row in self.rows if row[0] == quantity]
            lines = [self._line(title, values, method) for _, method, title, values in rows]
            if quantity == "chamfer":
                lines += [self._line(row[2], row[3]) for row in self.rows if row[0] == "chamfer_floor"]
                lines += self._paper_lines({method: title for _, method, title, _ in rows})
            parts += [f"**{heading}**", "", self._header(), *lines, ""]
        for sign, note in FOOTNOTES.items():
            if any(sign in signs for signs in self.marks.values()):
                parts += [f"{sign} {note}", ""]
        parts += [
            "The floor is the distance between two samplings of the true motion with the same number "
            "of tracers. The paper's distances contain a floor of their own, set by its 30,000 particles: "
            "compare excesses, not distances. Its scenes have the same starts but materials that it does not "
            "publish.",
            "",
        ]
        return "\n".join(parts)

    def _header(self) -> str:
        names = [*self.columns, "Average"]
        return f"| Method | {' | '.join(names)} |\n|---|{'---:|' * len(names)}"

    def _line(self, title: str, values: Sequence[float], method: str = "") -> str:
        marks = [self.marks.get((method, column), "") for column in self.columns]
        cells = [f"{v:.2f}{mark}" for v, mark in zip(_with_average(values), [*marks, ""], strict=True)]
        return f"| {title} | {' | '.join(cells)} |"

    def _paper_lines(self, titles: Mapping[str, str]) -> list[str]:
        """The paper's rows of the methods shown, if it has all the columns."""
        if not set(self.columns) <= set(PAPER_SCENES):
            return []
        lines = []
        for method in filter(PAPER_TABLE1.__contains__, titles):
            paper = dict(zip(PAPER_SCENES, PAPER_TABLE1[method], strict=True))
            lines.append(self._line(f"*paper: {titles[method]}*", [paper[c] for c in self.columns]))
        return lines


def chamfer_table(
    metrics: Mapping[str, Mapping[str, Mapping]], titles: Mapping[str, str], scenes: Sequence[str]
) -> Table:
    """Table 1 of the paper, with floor, excess and tracer error. Any method may have a row; none is implied.

    Args:
        metrics: method -> scene -> content of its metrics.json.
        titles: method -> name in the table, in the order of the rows.
        scenes: columns in order.

    Raises:
        InputError: a method lacks a scene, or a scene a finite value.
    """
    if not titles or not scenes:
        raise InputError("table 1: there are no methods or no scenes; see tables.table1 in the configuration")
    table = Table(tuple(scenes))

    def row(quantity: str, method: str) -> tuple[float, ...]:
        values = []
        for scene in scenes:
            value = metrics.get(method, {}).get(scene, {}).get(quantity)
            if not isinstance(value, int | float) or not math.isfinite(value):
                raise InputError(
                    f"table 1: {quantity} of {method} on {scene} is {value}; remove "
                    f"{scene}/{method}/metrics.json from the results and run again"
                )
            values.append(float(value))
        return tuple(values)

    for quantity in QUANTITIES:
        table.rows += [(quantity, method, title, row(quantity, method)) for method, title in titles.items()]
    first = next(iter(titles))
    table.rows.append(("chamfer_floor", "floor", "Sampling floor", row("chamfer_floor", first)))
    for method in titles:
        for scene in scenes:
            run = metrics[method][scene]
            signs = TRAINING_DIVERGED if run.get("stable") is False else ""
            signs += ROLLOUT_DIVERGED if run.get("diverged_at_step") is not None else ""
            if signs:
                table.marks[method, scene] = signs
    return table


def _with_average(values: Sequence[float]) -> list[float]:
    return [*values, sum(values) / len(values)]


def report_table(
    rows: Mapping[str, Mapping[str, float]], columns: Mapping[str, str], corner: str
) -> tuple[str, str]:
    """A plain table of numbers as CSV and as Markdown.

    Args:
        rows: row name -> quantity -> value.
        columns: quantity -> heading in the Markdown table, in order.
        corner: heading of the first column.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([corner, *columns])
    lines = [f"| {corner} | {' | '.join(columns.values())} |", f"|---|{'---:|' * len(columns)}"]
    for name, row in rows.items():
        writer.writerow([name, *(row[key] for key in columns)])
        cells = [f"{row[key]:d}" if isinstance(row[key], int) else f"{row[key]:.4g}" for key in columns]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return out.getvalue(), "\n".join(lines) + "\n"


def learning_rate_table(rows: Sequence[Mapping]) -> tuple[str, str, dict[str, float]]:
    """Compare learning rates: what every method reaches on every scene.

    Args:
        rows: one run each, with method, scene, lr_scale, loss (its history), best_loss, stable, recoveries and
            chamfer_excess.

    Returns:
        CSV, Markdown, and for each method the factor whose best training loss, relative to the loss of the prior and
        averaged over the scenes geometrically, is lowest.
    """
    header = (
        "method",
        "lr_scale",
        "scene",
        "loss of the prior",
        "best loss",
        "ratio",
        "recoveries",
        "stable",
        "excess",
    )
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    lines = [f"| {' | '.join(header)} |", f"|{'---|' * len(header)}"]
    logs: dict[str, dict[float, list[float]]] = {}
    for row in rows:
        first, best = row["loss"][0], row["best_loss"]
        logs.setdefault(row["method"], {}).setdefault(row["lr_scale"], []).append(math.log(best / first))
        cells = (
            row["method"], f"{row['lr_scale']:g}", row["scene"], f"{first:.3e}", f"{best:.3e}", f"{best / first:.4f}",
            len(row["recoveries"]), "yes" if row["stable"] else "no", f"{row['chamfer_excess']:.3f}",
        )  # fmt: skip
        writer.writerow(cells)
        lines.append(f"| {' | '.join(map(str, cells))} |")
    chosen = {
        method: min(scales, key=lambda scale: sum(scales[scale]) / len(scales[scale]))
        for method, scales in logs.items()
    }
    lines += ["", "Best by training loss: " + ", ".join(f"{m} ×{s:g}" for m, s in chosen.items()) + "."]
    return out.getvalue(), "\n".join(lines) + "\n", chosen
