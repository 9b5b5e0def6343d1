"""Tables of errors as CSV and Markdown, with the paper's numbers and verdicts on claims.

Claims are checked with the tracer RMSE. The Chamfer distance, the paper's measure, is listed with its sampling floor
(`neuma_lib.evaluation.motion` explains its limits).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.evaluation.text_tables import as_csv, as_markdown
from neuma_lib.paper.claims import (
    BROKEN,
    PRINTED,
    RMSE,
    RULE,
    VERDICTS,
    Frame,
    Row,
    Verdict,
    check,
    shown,
    spread_note,
    verdict_lines,
)
from neuma_lib.paper.published import BALL_FLOOR, PaperTable

QUANTITIES = {
    RMSE: "Tracer RMSE from identical start points (mm)",
    "tracer_error_p95_mm": "95 %",
    "tracer_rmse_last_mm": "Last frame",
    "chamfer": "Chamfer distance (1e-4 m², mean over the sequence)",
    "chamfer_excess": "Excess over the sampling floor (1e-4 m²)",
}
"""Quantities of metrics.json in the order of the CSV, and their headings."""
FLOOR = "chamfer_floor"
TRUE_LAW = "true_law"
REFERENCES = (TRUE_LAW,)  # methods that know the truth and do not compete for the lowest error

TRAINING_DIVERGED, ROLLOUT_DIVERGED = "†", "‡"
FOOTNOTES = {
    TRAINING_DIVERGED: "The training diverged. Numbers are those of its best state.",
    ROLLOUT_DIVERGED: "A prediction broke off. Its later frames repeat the last valid state, so its error is too "
    "small. Averages with it are marked too.",
}
"""Signs after numbers, and their meaning."""

ABSORBED = "The true law, simulated as the reconstruction is"  # start of the paragraph of `Table.absorbed`


@dataclass
class Table(Frame):
    """Errors of methods with footnotes. The last column of its texts is the average."""

    paper: PaperTable | None = None  # the table of the paper to compare with, if any
    # (method, column) -> signs of `FOOTNOTES`, for runs that diverged
    marks: dict[tuple[str, str], str] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)  # a sentence for each prediction that stopped early
    notes: Mapping[str, str] = field(default_factory=dict)  # method -> footnote
    note: str | None = None  # text below the heading

    def wins(self) -> dict[str, int]:
        """Number of columns in which each method, except `REFERENCES`, has the lowest mean RMSE."""
        rows = self._competing()
        lowest = np.min([row.mean[:-1] for row in rows], axis=0) if rows else 0
        return {row.method: int((row.mean[:-1] <= lowest).sum()) for row in rows}

    def csv(self) -> str:
        """Comma-separated values: quantity, method, title, one column a scene, Average, Median, wins, diverged.

        With several replicates, a row ``<quantity>_std`` follows each row of means.
        """
        wins = self.wins()
        lines = [["quantity", "method", "title", *self.columns, "Average", "Median", "wins", "diverged"]]
        for row in (row for quantity in (*QUANTITIES, FLOOR) for row in self.of(quantity)):
            diverged = " ".join(c for c in self.columns if (row.method, c) in self.marks)
            ends = [f"{row.median:.4f}", wins.get(row.method, "") if row.quantity == RMSE else ""], ["", ""]
            lines += [[*cells, *end, diverged] for cells, end in zip(row.csv_rows(), ends)]
        return as_csv(lines)

    def markdown(self) -> str:
        """Note, RMSE of all methods, their Chamfer distances with the paper's, footnotes, and verdicts on claims."""
        parts = [f"# {self.paper.heading}", ""] if self.paper else []
        parts += [self.note, ""] if self.note else []
        parts += [*self._errors(), *self._distances()]
        paragraphs = [spread_note(max(len(row.runs) for row in self.rows.values()))]
        signs = "".join(self.marks.values())
        paragraphs += [f"{sign} {note}" for sign, note in FOOTNOTES.items() if sign in signs]
        if remarks := [*self.failures, *self.outliers()]:
            paragraphs.append("\n".join(f"- {line}" for line in remarks))
        notes = [f"{self._note_sign(method)} {note}" for method, note in self.notes.items()]
        for paragraph in filter(None, [*paragraphs, self.absorbed(), *notes]):
            parts += [paragraph, ""]
        if verdicts := self.verdicts():
            parts += [*verdict_lines(verdicts, VERDICTS[2], paper=True), RULE, ""]
        return "\n".join(parts)

    def verdicts(self) -> list[Verdict]:
        """A verdict on each claim whose rows and columns the table has."""
        return check(self.paper.claims if self.paper else (), self)

    def outliers(self) -> list[str]:
        """A sentence for each run whose RMSE is more than twice the mean of its method in the column."""
        return [
            f"{row.title} on {heading}, replicate {k + 1} of {len(row.runs)}: {row.runs[k, c]:.1f} mm, more than twice "
            "the mean of its replicates."
            for row in self.of(RMSE)
            for c, heading in enumerate(self.columns.values())
            for k in range(len(row.runs))
            if row.runs[k, c] > 2 * row.mean[c]
        ]

    def absorbed(self) -> str | None:
        """How much closer to the truth learned laws are than the true law itself. None if that has no row."""
        if (RMSE, TRUE_LAW) not in self.rows:
            return None
        true = self.rows[RMSE, TRUE_LAW].mean[:-1]
        closer = []
        for row in self._competing():
            gain = true - row.mean[:-1]
            where = (gain > 0) & ~np.array([(row.method, column) in self.broken for column in self.columns])
            if where.any():
                closer.append(
                    f"{row.title} in {where.sum()} of {len(where)} columns (there by {gain[where].mean():.1f} of "
                    f"{true[where].mean():.1f} mm on average)"
                )
        gains = f"Closer to the truth than it: {'; '.join(closer)}." if closer else "None is closer than it."
        return (
            f"{ABSORBED}, shows the error that remains with the right law: that of start, particles, grid and time "
            f"step. {gains} Lower errors than those of the true law are no knowledge of the material: the law has "
            "absorbed discretisation, or errors of the start."
        )

    def _competing(self) -> list[Row]:
        return [row for row in self.of(RMSE) if row.method.partition("+")[0] not in REFERENCES]

    def _errors(self) -> list[str]:
        """The table of tracer errors."""
        wins, rows = self.wins(), []
        several, compared = len(self.columns) > 1, len(wins) > 1
        others = ("tracer_error_p95_mm", "tracer_rmse_last_mm")
        for row in self.of(RMSE):
            values = [row.median] if several else []
            values += [self.rows[name, row.method].mean[-1] for name in others]
            best = f"{wins[row.method]} of {len(self.columns)}" if row.method in wins else ""
            cells = [shown(value, 1) + self._average_mark(row) for value in values]
            rows.append([*self._cells(row, 1), *cells, *([best] if compared else [])])
        heads = ["Average", *(["Median"] if several else []), *(QUANTITIES[name] for name in others)]
        note = "95 %: the 95th percentile of the distances of all tracers in all frames. Last frame: the RMSE in it."
        if several:
            note += " Both are averages over the columns. The median is that of all runs of a row."
        if compared:
            heads.append("Best in")
            note += " Best in: columns in which a row has the lowest mean."
        return self._section(RMSE, heads, rows, note)

    def _distances(self) -> list[str]:
        """The table of Chamfer distances with the paper's below ours, and the floor."""
        rows = []
        note = (
            "The floor is the distance between two random sets of as many tracers with the true motion. The distance "
            "compares shapes only, so small errors of the motion have little effect on it."
        )
        printed = {row.method: row.mean for row in self.of(PRINTED) if np.isfinite(row.mean[-1])}
        for row in self.of("chamfer"):
            rows.append(self._cells(row, 2))
            if row.method in printed:
                rows.append(["*paper*", *(f"*{v:.2f}*" for v in printed[row.method])])
        rows += [self._cells(row, 2) for row in self.of(FLOOR)]
        if printed:
            note += (
                f" The paper's numbers ({self.paper.label}) are for unpublished materials, and contain another floor, "
                "that of its particles."
            )
            note += f" {BALL_FLOOR}" if "BouncyBall" in self.columns else ""
        return self._section("chamfer", ["Average"], rows, note)

    def _section(
        self, quantity: str, heads: Sequence[str], rows: Sequence[Sequence[str]], note: str
    ) -> list[str]:
        header = ["Method", *self.columns.values(), *heads]
        return [f"**{QUANTITIES[quantity]}**", "", *as_markdown(header, rows, numbers=True), "", note, ""]

    def _average_mark(self, row: Row) -> str:
        signs = "".join(self.marks.get((row.method, column), "") for column in self.columns)
        return "".join(sign for sign in FOOTNOTES if sign in signs)

    def _cells(self, row: Row, digits: int) -> list[str]:
        marks = [*(self.marks.get((row.method, c), "") for c in self.columns), self._average_mark(row)]
        title = f"{row.title} {self._note_sign(row.method)}".rstrip()
        return [title, *map("".join, zip(row.cells(digits, shown), marks, strict=True))]

    def _note_sign(self, method: str) -> str:
        """The sign after the title of a method with a note, else nothing."""
        return f"({list(self.notes).index(method) + 1})" if method in self.notes else ""


def chamfer_table(
    metrics: Mapping[str, Mapping[str, Sequence[Mapping]]],
    titles: Mapping[str, str],
    columns: Mapping[str, str],
    paper: PaperTable | None = None,
    notes: Mapping[str, str] | None = None,
    note: str | None = None,
) -> Table:
    """A table of tracer errors and Chamfer distances of any methods.

    Args:
        metrics: method -> scene or experiment -> content of metrics.json, one for each replicate.
        titles: method -> name in the table, in the order of the rows.
        columns: scene or experiment -> heading, in order.
        paper: the table of the paper to compare with.
        notes: method -> footnote.

    Raises:
        InputError: there are no methods or columns, a method lacks a column, or a value is not finite.
    """
    if not titles or not columns:
        problem = "no methods, or neither scenes nor experiments"
        raise InputError("tables", problem, "Name some in the table's settings")
    table = Table(dict(columns), paper=paper, notes=notes or {}, note=note)

    def values(quantity: str, method: str) -> list[list[float]]:
        count = min(len(metrics[method][column]) for column in columns)
        return [[_value(quantity, method, c, metrics[method][c][k]) for c in columns] for k in range(count)]

    for method, column in product(titles, columns):
        if not metrics.get(method, {}).get(column):
            problem = f"no metrics.json of {method} on {column}"
            raise InputError("tables", problem, "Compute it, or remove the method")
    for quantity, method in product((*QUANTITIES, BROKEN), titles):
        table.add(quantity, method, titles[method], values(quantity, method))
    table.add(FLOOR, "floor", "Sampling floor", values(FLOOR, next(iter(titles)))[:1])
    for method, title in titles.items():
        if paper and method in paper.rows:
            known = dict(zip(paper.columns, paper.rows[method], strict=True))
            table.add(PRINTED, method, "*paper*", [[known.get(column, math.nan) for column in columns]])
        for column, heading in columns.items():
            runs = metrics[method][column]
            if any(run.get("stable") is False for run in runs):
                table.diverged.add((method, column))
            signs = TRAINING_DIVERGED * ((method, column) in table.diverged)
            for k, run in enumerate(runs):
                if run.get("diverged"):
                    table.broken.add((method, column))
                    replicate = f", replicate {k + 1} of {len(runs)}" if len(runs) > 1 else ""
                    table.failures.append(f"{title} on {heading}{replicate}: {_describe_failure(run)}")
            if signs := signs + ROLLOUT_DIVERGED * ((method, column) in table.broken):
                table.marks[method, column] = signs
    return table


def _describe_failure(run: Mapping) -> str:
    """What happened in a prediction that stopped early, and when it began to gain energy."""
    failure, gain = run["diverged"], run["energy_gain_after_step"]
    energy = f"energy exceeded that of the start after step {gain}"
    if gain is None:
        energy = "energy did not exceed that of the start before"
    what = f"particle {failure['particle']} {failure['happened']} at step {failure['step']} of {run['frames'][-1]}"
    return f"{what}; {energy}."


def _value(quantity: str, method: str, column: str, run: Mapping) -> float:
    value = 100.0 * bool(run.get("diverged")) if quantity == BROKEN else run.get(quantity)
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(
            f"{column}/{method}/metrics.json",
            f"{quantity} of {method} on {column} is {value}, not a finite number",
            "Remove the file from the results and run again",
        )
    return float(value)
