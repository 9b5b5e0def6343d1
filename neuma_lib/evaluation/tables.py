"""Tables of Chamfer distances from metrics: CSV for programs, Markdown for people, the paper's numbers beside ours."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.evaluation.paper import Claim, PaperTable
from neuma_lib.evaluation.reports import as_csv, as_markdown

QUANTITIES = {
    "chamfer": "Chamfer distance (1e-4 m², mean over the sequence)",
    "chamfer_excess": "Excess over the sampling floor (1e-4 m²)",
    "tracer_rmse_mm": "Tracer RMSE from identical start points (mm)",
}
"""What is shown of each run, by its name in metrics.json."""
JUDGED = "chamfer_excess"
"""Quantity that claims are judged by: distances of other scenes and other floors cannot be compared."""

TRAINING_DIVERGED, ROLLOUT_DIVERGED = "†", "‡"
FOOTNOTES = {
    TRAINING_DIVERGED: "The training diverged; its best state is shown.",
    ROLLOUT_DIVERGED: "The predicted motion became non-finite; later frames hold the last finite state.",
}
"""Signs behind numbers, and what they mean."""


@dataclass(frozen=True)
class Row:
    """Numbers of one quantity and method.

    Attributes:
        quantity: its name in metrics.json.
        method: name of the method, or "floor".
        title: name in the table.
        runs: one line a seed, one column a scene or experiment, shape (S, C).
    """

    quantity: str
    method: str
    title: str
    runs: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """Means over the seeds with the average over all columns behind them, shape (C + 1,)."""
        return self._averaged().mean(axis=0)

    @property
    def std(self) -> np.ndarray | None:
        """Standard deviations over the seeds (of the average too), shape (C + 1,); None with a single seed."""
        return self._averaged().std(axis=0, ddof=1) if len(self.runs) > 1 else None

    def _averaged(self) -> np.ndarray:
        return np.concatenate([self.runs, self.runs.mean(axis=1, keepdims=True)], axis=1)


@dataclass
class Table:
    """Numbers with row and column names; the last column is the average.

    Attributes:
        columns: column names without the average -> their headings.
        paper: the table of the paper that it stands beside, if any.
        rows: in order.
        marks: (method, column) -> signs of `FOOTNOTES`, for runs that diverged.
        notes: method -> what a reader must know of its numbers.
    """

    columns: dict[str, str]
    paper: PaperTable | None = None
    rows: list[Row] = field(default_factory=list)
    marks: dict[tuple[str, str], str] = field(default_factory=dict)
    notes: Mapping[str, str] = field(default_factory=dict)

    def row(self, quantity: str, method: str) -> Row:
        """One row.

        Raises:
            InputError: there is none.
        """
        for row in self.rows:
            if (row.quantity, row.method) == (quantity, method):
                return row
        raise InputError(f"table: no row {quantity} of {method}")

    def csv(self) -> str:
        """Comma-separated values: quantity, method, title, one column a scene, Average, diverged.

        With several seeds, a row ``<quantity>_std`` follows each row of means.
        """
        lines = [["quantity", "method", "title", *self.columns, "Average", "diverged"]]
        for row in self.rows:
            diverged = " ".join(c for c in self.columns if (row.method, c) in self.marks)
            for suffix, values in (("", row.mean), ("_std", row.std)):
                if values is not None:
                    cells = [f"{v:.4f}" for v in values]
                    lines.append([row.quantity + suffix, row.method, row.title, *cells, diverged])
        return as_csv(lines)

    def markdown(self) -> str:
        """One Markdown table a quantity, the paper's numbers below the Chamfer distances, and what holds of it."""
        paper = self.paper
        parts = [f"# {paper.heading}", ""] if paper else []
        printed: list[Row] = []
        for quantity, heading in QUANTITIES.items():
            rows = [row for row in self.rows if row.quantity == quantity]
            if quantity == "chamfer":
                printed = self._paper_rows(rows)
                rows += [row for row in self.rows if row.quantity == "chamfer_floor"] + printed
            header = ["Method", *self.columns.values(), "Average"]
            parts += [f"**{heading}**", "", *as_markdown(header, map(self._cells, rows), numbers=True), ""]
        if any(len(row.runs) > 1 for row in self.rows):
            parts += ["± is the standard deviation over chains of other seeds.", ""]
        for sign, note in FOOTNOTES.items():
            if any(sign in signs for signs in self.marks.values()):
                parts += [f"{sign} {note}", ""]
        for method, note in self.notes.items():
            parts += [f"{self._note_sign(method)} {note}", ""]
        if verdicts := self.verdicts():
            parts += ["**What holds**", "", *(f"- {line}" for line in verdicts), ""]
        parts += [
            "The floor is the distance between two samplings of the true motion with the same number "
            "of tracers. The paper's distances contain a floor of their own, set by its 30,000 particles: "
            "compare excesses, not distances. Its scenes have the same starts but materials that it does not "
            "publish." + (f" Its numbers are those of {paper.label}." if printed else ""),
            "",
        ]
        return "\n".join(parts)

    def verdicts(self) -> list[str]:
        """A sentence for each claim whose rows and columns are here: whether it holds, with the numbers."""
        claims = self.paper.claims if self.paper else ()
        methods = {row.method for row in self.rows}
        return [
            self._verdict(claim)
            for claim in claims
            if {*claim.better, *claim.worse} <= methods and set(claim.columns) <= set(self.columns)
        ]

    def _verdict(self, claim: Claim) -> str:
        columns = claim.columns or tuple(self.columns)
        index = [list(self.columns).index(column) for column in columns]

        def means(method: str) -> np.ndarray:
            return self.row(JUDGED, method).mean[index]

        highest = max(claim.better, key=lambda method: means(method).mean())
        lowest = min(claim.worse, key=lambda method: means(method).mean())
        ours = [float(means(method).mean()) for method in (highest, lowest)]
        per_column = [np.stack([means(m) for m in group]) for group in (claim.better, claim.worse)]
        lower = int((per_column[0].max(axis=0) <= per_column[1].min(axis=0)).sum())
        titles = [self.row(JUDGED, method).title for method in (highest, lowest)]
        said = f"{'Holds' if ours[0] <= ours[1] else 'Does not hold'}: {claim.text.rstrip('.')}."
        said += f" Excess {ours[0]:.3f} ({titles[0]}) against {ours[1]:.3f} ({titles[1]}) on average;"
        said += f" it is so in {lower} of {len(columns)} columns."
        return said + self._paper_verdict(claim, columns)

    def _paper_verdict(self, claim: Claim, columns: Sequence[str]) -> str:
        """The same comparison with the paper's distances."""
        if not claim.by_paper:
            return " The paper does not compare these."
        groups = [
            [self.paper.row(method, columns) for method in group] for group in (claim.better, claim.worse)
        ]
        if any(row is None for group in groups for row in group):
            return ""
        means = [[sum(row) / len(row) for row in group] for group in groups]
        return f" Paper, floors included: {max(means[0]):.2f} against {min(means[1]):.2f}."

    def _cells(self, row: Row) -> list[str]:
        marks = [*(self.marks.get((row.method, column), "") for column in self.columns), ""]
        spread = [""] * len(marks) if row.std is None else [f" ± {s:.2f}" for s in row.std]
        title = f"{row.title} {self._note_sign(row.method)}".rstrip()
        return [title, *(f"{v:.2f}{s}{m}" for v, s, m in zip(row.mean, spread, marks, strict=True))]

    def _note_sign(self, method: str) -> str:
        """The sign behind the title of a method that has a note, else nothing."""
        return f"({list(self.notes).index(method) + 1})" if method in self.notes else ""

    def _paper_rows(self, rows: Sequence[Row]) -> list[Row]:
        """The paper's rows of the methods shown, if it has all the columns."""
        if not self.paper:
            return []
        printed = [(row.title, self.paper.row(row.method, list(self.columns))) for row in rows]
        return [Row("chamfer", "", f"*paper: {title}*", np.array([v])) for title, v in printed if v]


def chamfer_table(
    metrics: Mapping[str, Mapping[str, Sequence[Mapping]]],
    titles: Mapping[str, str],
    columns: Mapping[str, str],
    paper: PaperTable | None = None,
    notes: Mapping[str, str] | None = None,
) -> Table:
    """A table of distances with floor, excess and tracer error. Any method may have a row; none is implied.

    Args:
        metrics: method -> scene or experiment -> content of its metrics.json, one a seed.
        titles: method -> name in the table, in the order of the rows.
        columns: scene or experiment -> heading, in order.
        paper: what to show beside it.
        notes: method -> what a reader must know of its numbers.

    Raises:
        InputError: a method lacks a column, or a column a finite value.
    """
    if not titles or not columns:
        raise InputError(
            "table: there are no methods, or no scenes and experiments; see tables in the configuration"
        )
    table = Table(dict(columns), paper, notes=notes or {})

    def row(quantity: str, method: str, title: str) -> Row:
        seeds = min(len(metrics.get(method, {}).get(column, ())) for column in columns)
        runs = [
            [_number(quantity, method, column, metrics[method][column][k]) for column in columns]
            for k in range(seeds)
        ]
        if not runs:
            missing = next(column for column in columns if not metrics.get(method, {}).get(column))
            raise InputError(f"table: there is no metrics.json of {method} on {missing}")
        return Row(quantity, method, title, np.array(runs))

    for quantity in QUANTITIES:
        table.rows += [row(quantity, method, title) for method, title in titles.items()]
    floor = row("chamfer_floor", next(iter(titles)), "Sampling floor").runs[:1]
    table.rows.append(Row("chamfer_floor", "floor", "Sampling floor", floor))
    for method in titles:
        for column in columns:
            runs = metrics[method][column]
            signs = TRAINING_DIVERGED if any(run.get("stable") is False for run in runs) else ""
            signs += ROLLOUT_DIVERGED if any(run.get("diverged_at_step") is not None for run in runs) else ""
            if signs:
                table.marks[method, column] = signs
    return table


def _number(quantity: str, method: str, column: str, run: Mapping) -> float:
    value = run.get(quantity)
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(
            f"table: {quantity} of {method} on {column} is {value}; remove "
            f"{column}/{method}/metrics.json from the results and run again"
        )
    return float(value)
