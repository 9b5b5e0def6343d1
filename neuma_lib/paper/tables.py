"""Tables of errors from metrics: CSV for programs, Markdown for people, the paper's numbers beside, and what holds.

The tracer RMSE comes first and decides. The Chamfer distance, the paper's measure, comes second, as it is, with its
sampling floor (`neuma_lib.evaluation.motion` says what it does not see).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.evaluation.text_tables import as_csv, as_markdown
from neuma_lib.paper.published import BALL_FLOOR, BROKEN, Claim, PaperTable, Target

QUANTITIES = {
    "tracer_rmse_mm": "Tracer RMSE from identical start points (mm)",
    "tracer_error_p95_mm": "95 %",
    "tracer_rmse_last_mm": "Last frame",
    "chamfer": "Chamfer distance (1e-4 m², mean over the sequence)",
    "chamfer_excess": "Excess over the sampling floor (1e-4 m²)",
}
"""What is written of each run, by its name in metrics.json, in the order of the CSV; and its heading, if it has one."""
JUDGED = "tracer_rmse_mm"
"""Quantity that claims are judged by: it sees all motion and has no floor."""
TRUE_LAW = "true_law"
YARDSTICKS = (TRUE_LAW,)
"""Methods that know the truth and do not compete for the lowest error."""
MIN_CHAINS = 3
"""Fewer runs give no spread to judge by."""

TRAINING_DIVERGED, ROLLOUT_DIVERGED = "†", "‡"
FOOTNOTES = {
    TRAINING_DIVERGED: "The training diverged; its best state is shown.",
    ROLLOUT_DIVERGED: "A predicted motion broke off; its later frames hold the last sound state, from which the error "
    "is too small. Averages with it are marked too.",
}
"""Signs behind numbers, and what they mean."""

ABSORBED = "The true law, simulated as the reconstruction is"
"""How the paragraph of `Table.absorbed` begins."""

VERDICTS = ("claim", "verdict", "RMSE here (mm)", "Chamfer distance in the paper")
"""Columns of the table of verdicts."""
HOLDS, MIXED, FAILS = "holds", "mixed", "does not hold"


@dataclass(frozen=True)
class Row:
    """Numbers of one quantity and method.

    Attributes:
        quantity: its name in metrics.json.
        method: name of the method, or "floor".
        title: name in the table.
        runs: one line a chain, one column a scene or experiment, shape (S, C).
    """

    quantity: str
    method: str
    title: str
    runs: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """Means over the chains with the average over all columns behind them, shape (C + 1,)."""
        return self._averaged().mean(axis=0)

    @property
    def std(self) -> np.ndarray | None:
        """Standard deviations over the chains (of the average too), shape (C + 1,); None with a single one."""
        return self._averaged().std(axis=0, ddof=1) if len(self.runs) > 1 else None

    @property
    def median(self) -> float:
        """Median over all runs, chains and columns together."""
        return float(np.median(self.runs))

    def over(self, columns: Sequence[int]) -> Row:
        """The same of some columns."""
        return Row(self.quantity, self.method, self.title, self.runs[:, columns])

    def _averaged(self) -> np.ndarray:
        return np.concatenate([self.runs, self.runs.mean(axis=1, keepdims=True)], axis=1)


@dataclass(frozen=True)
class Verdict:
    """What became of a claim.

    Attributes:
        claim: the claim or target.
        word: "holds", "mixed" or "does not hold".
        here: our numbers, and what keeps it from holding.
        paper: the paper's Chamfer distances, or why there are none.
    """

    claim: Claim | Target
    word: str
    here: str
    paper: str

    def __str__(self) -> str:
        return f"{self.word.capitalize()}: {self.claim.text}. {self.here}."


@dataclass
class Table:
    """Numbers with row and column names; the last column is the average.

    Attributes:
        columns: column names without the average -> their headings.
        paper: the table of the paper that it stands beside, if any.
        rows: in order.
        marks: (method, column) -> signs of `FOOTNOTES`, for runs that diverged.
        failures: what happened in each prediction that broke off.
        notes: method -> what a reader must know of its numbers.
        note: what a reader must know of the whole table.
    """

    columns: dict[str, str]
    paper: PaperTable | None = None
    rows: list[Row] = field(default_factory=list)
    marks: dict[tuple[str, str], str] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)
    notes: Mapping[str, str] = field(default_factory=dict)
    note: str | None = None

    def row(self, quantity: str, method: str) -> Row:
        """One row.

        Raises:
            InputError: there is none.
        """
        for row in self.rows:
            if (row.quantity, row.method) == (quantity, method):
                return row
        raise InputError(f"table: no row {quantity} of {method}")

    def wins(self) -> dict[str, int]:
        """In how many columns each method has the lowest mean of `JUDGED`; those of `YARDSTICKS` are left out."""
        rows = [r for r in self._rows(JUDGED) if r.method.partition("+")[0] not in YARDSTICKS]
        lowest = np.min([row.mean[:-1] for row in rows], axis=0) if rows else 0
        return {row.method: int((row.mean[:-1] <= lowest).sum()) for row in rows}

    def csv(self) -> str:
        """Comma-separated values: quantity, method, title, one column a scene, Average, Median, wins, diverged.

        With several chains, a row ``<quantity>_std`` follows each row of means.
        """
        wins = self.wins()
        lines = [["quantity", "method", "title", *self.columns, "Average", "Median", "wins", "diverged"]]
        for row in self.rows:
            if row.quantity == BROKEN:  # the last column says it
                continue
            diverged = " ".join(c for c in self.columns if (row.method, c) in self.marks)
            best = wins.get(row.method, "") if row.quantity == JUDGED else ""
            ends = ("", row.mean, [f"{row.median:.4f}", best]), ("_std", row.std, ["", ""])
            for suffix, values, end in ends:
                if values is not None:
                    cells = [f"{v:.4f}" for v in values]
                    lines.append([row.quantity + suffix, row.method, row.title, *cells, *end, diverged])
        return as_csv(lines)

    def markdown(self) -> str:
        """The RMSE of all methods, their Chamfer distances with the paper's, and what holds of the paper's claims."""
        parts = [f"# {self.paper.heading}", ""] if self.paper else []
        parts += [*self._errors(), *self._distances()]
        if chains := max(len(row.runs) for row in self.rows) - 1:
            parts += [
                f"± is the standard deviation over {chains + 1} chains; behind an average, of their averages.",
                "",
            ]
        for sign, note in FOOTNOTES.items():
            if any(sign in signs for signs in self.marks.values()):
                parts += [f"{sign} {note}", ""]
        if told := [*self.failures, *self.outliers()]:
            parts += [*(f"- {line}" for line in told), ""]
        parts += [self.absorbed(), ""] if self.absorbed() else []
        for method, note in self.notes.items():
            parts += [f"{self._note_sign(method)} {note}", ""]
        parts += [self.note, ""] if self.note else []
        if verdicts := self.verdicts():
            rows = [[v.claim.text, f"**{v.word}**", v.here, v.paper] for v in verdicts]
            parts += ["**What holds**", "", *as_markdown(VERDICTS, rows), "", RULE, ""]
        return "\n".join(parts)

    def verdicts(self) -> list[Verdict]:
        """A verdict on each claim and each target whose rows and columns are here."""
        methods = {row.method for row in self.rows}
        claims, targets = (self.paper.claims, self.paper.targets) if self.paper else ((), ())
        found = [
            self._verdict(claim)
            for claim in claims
            if {*claim.better, *claim.worse} <= methods and set(claim.columns) <= set(self.columns)
        ]
        rows, broke_off = ({row.method: row for row in self._rows(name)} for name in (JUDGED, BROKEN))
        broken = {cell for cell, signs in self.marks.items() if ROLLOUT_DIVERGED in signs}
        columns = list(self.columns)
        found += reached(targets, rows, columns, "mm", broken)
        return found + reached(targets, broke_off, columns, "%", quantity=BROKEN)

    def outliers(self) -> list[str]:
        """Runs whose `JUDGED` is more than twice the mean of their method's chains in the column, a sentence each."""
        return [
            f"{row.title} on {heading}, chain {k + 1} of {len(row.runs)}: {row.runs[k, c]:.1f} mm, more than twice the "
            "mean of its chains."
            for row in self._rows(JUDGED)
            for c, heading in enumerate(self.columns.values())
            for k in range(len(row.runs))
            if row.runs[k, c] > 2 * row.mean[c]
        ]

    def absorbed(self) -> str | None:
        """How far learned laws are closer to the truth than the true law itself; None if that has no row."""
        if not any(row.method == TRUE_LAW for row in self.rows):
            return None
        true = self.row(JUDGED, TRUE_LAW).mean[:-1]
        closer = []
        for row in self._rows(JUDGED):
            gain = true - row.mean[:-1]
            broken = [ROLLOUT_DIVERGED in self.marks.get((row.method, column), "") for column in self.columns]
            where = (gain > 0) & ~np.array(broken)
            if where.any() and row.method.partition("+")[0] not in YARDSTICKS:
                closer += [
                    f"{row.title} in {where.sum()} of {len(where)} columns (there by {gain[where].mean():.1f} of "
                    f"{true[where].mean():.1f} mm on average)"
                ]
        return (
            f"{ABSORBED}, shows what error remains when the law is right: that of "
            "start, particles, grid and time step. "
            + (
                f"Closer to the truth than it: {'; '.join(closer)}. "
                if closer
                else "None is closer than it. "
            )
            + "What a law gains over the true one is no knowledge of the material: it has absorbed "
            "discretisation, or errors of the start."
        )

    def _rows(self, quantity: str) -> list[Row]:
        return [row for row in self.rows if row.quantity == quantity]

    def _errors(self) -> list[str]:
        """The table of tracer errors."""
        wins, heads, rows = self.wins(), ["Average"], []
        several = len(self.columns) > 1
        heads += ["Median"] if several else []
        heads += [QUANTITIES["tracer_error_p95_mm"], QUANTITIES["tracer_rmse_last_mm"]]
        compared = len(wins) > 1
        for row in self._rows(JUDGED):
            others = [self.row(name, row.method) for name in ("tracer_error_p95_mm", "tracer_rmse_last_mm")]
            sign = self._average_mark(row)
            cells = [f"{shown(row.median, 1)}{sign}"] if several else []
            cells += [f"{shown(other.mean[-1], 1)}{sign}" for other in others]
            best = f"{wins[row.method]} of {len(self.columns)}" if row.method in wins else ""
            rows.append([*self._cells(row, 1), *cells, *([best] if compared else [])])
        header = ["Method", *self.columns.values(), *heads, *(["Best in"] if compared else [])]
        note = "95 %: the distance that 95 % of all tracers, over all frames, stay below. Last frame: the RMSE in it."
        if several:
            note += " Both are averages over the columns; the median is that of all runs of a row."
        if compared:
            note += " Best in: columns in which a row has the lowest mean."
        return [f"**{QUANTITIES[JUDGED]}**", "", *as_markdown(header, rows, numbers=True), "", note, ""]

    def _distances(self) -> list[str]:
        """The table of Chamfer distances, the paper's below ours, and its floor."""
        rows, printed = [], False
        for row in self._rows("chamfer"):
            rows.append(self._cells(row, 2))
            values = self.paper.row(row.method, list(self.columns)) if self.paper else None
            if values:
                printed = True
                rows.append(["*paper*", *(f"*{v:.2f}*" for v in (*values, sum(values) / len(values)))])
        rows += [self._cells(row, 2) for row in self._rows("chamfer_floor")]
        header = ["Method", *self.columns.values(), "Average"]
        note = (
            "The floor is the distance between two samplings of the true motion with as many tracers. The distance "
            "sees outlines alone, so small errors of the motion hardly show in it."
        )
        if printed:
            note += (
                f" The paper's numbers ({self.paper.label}) are of materials that it does not publish, and contain a "
                "floor of its own, set by its particles."
            )
            note += f" {BALL_FLOOR}" if "BouncyBall" in self.columns else ""
        return [f"**{QUANTITIES['chamfer']}**", "", *as_markdown(header, rows, numbers=True), "", note, ""]

    def _verdict(self, claim: Claim) -> Verdict:
        """Whether a claim holds, is mixed or does not hold.

        The burden of proof is on the claim, "these methods are closer than those". It *holds* only if all of this is
        so: the average error is lower; it is lower in more than half of the columns; the intervals mean ± standard
        deviation over the chains, of the averages as they stand in the table, do not overlap; there are `MIN_CHAINS`
        chains at least; and no prediction of the methods said to be closer broke off, since a motion that is held
        counts less than its error. (For three chains of equal spread, no overlap is t > 2.4, which chance gives in
        4 of 100 cases.) It *does not hold* if neither the average nor the majority of columns is on its side. All
        else is *mixed*; with a single run a claim can be no more. "No worse" is judged as "closer": that a difference
        was not seen does not show that there is none.
        """
        columns = claim.columns or tuple(self.columns)
        index = [list(self.columns).index(column) for column in columns]
        better, worse = (
            [self.row(JUDGED, m).over(index) for m in group] for group in (claim.better, claim.worse)
        )
        high, low = max(better, key=lambda r: r.mean[-1]), min(worse, key=lambda r: r.mean[-1])
        average = bool(high.mean[-1] < low.mean[-1])
        columnwise = [np.stack([row.mean[:-1] for row in rows]) for rows in (better, worse)]
        lower = int((columnwise[0].max(axis=0) < columnwise[1].min(axis=0)).sum())
        majority = 2 * lower > len(columns)
        fewest = min(len(row.runs) for row in (*better, *worse))
        if not (average or majority):
            word, why = FAILS, ""
        else:
            doubts = [] if average else ["not on average"]
            doubts += [] if majority else ["not in most columns"]
            if fewest < MIN_CHAINS:
                doubts.append(f"{fewest} run{'s' if fewest > 1 else ''}, no spread to judge by")
            elif average and max(r.mean[-1] + r.std[-1] for r in better) >= min(
                r.mean[-1] - r.std[-1] for r in worse
            ):
                doubts.append("the ± overlap")
            signs = [self.marks.get((m, c), "") for m in claim.better for c in columns]
            if any(ROLLOUT_DIVERGED in sign for sign in signs):
                doubts.append("a prediction broke off")
            word, why = (MIXED, f"; {', '.join(doubts)}") if doubts else (HOLDS, "")
        here = f"{spread(high)} ({high.title}) against {spread(low)} ({low.title})"
        return Verdict(
            claim, word, f"{here}, lower in {lower} of {len(columns)}{why}", self._of_paper(claim, columns)
        )

    def _of_paper(self, claim: Claim, columns: Sequence[str]) -> str:
        """The same comparison with the paper's distances."""
        if not claim.by_paper:
            return "not compared there"
        groups = [
            [self.paper.row(method, columns) for method in group] for group in (claim.better, claim.worse)
        ]
        if any(row is None for group in groups for row in group):
            return ""
        means = [[sum(row) / len(row) for row in group] for group in groups]
        return f"{max(means[0]):.2f} against {min(means[1]):.2f}"

    def _average_mark(self, row: Row) -> str:
        signs = "".join(self.marks.get((row.method, column), "") for column in self.columns)
        return "".join(sign for sign in FOOTNOTES if sign in signs)

    def _cells(self, row: Row, digits: int) -> list[str]:
        marks = [
            *(self.marks.get((row.method, column), "") for column in self.columns),
            self._average_mark(row),
        ]
        spreads = [""] * len(marks) if row.std is None else [f" ± {shown(s, digits)}" for s in row.std]
        cells = zip(row.mean, spreads, marks, strict=True)
        title = f"{row.title} {self._note_sign(row.method)}".rstrip()
        return [title, *(f"{shown(v, digits)}{s}{m}" for v, s, m in cells)]

    def _note_sign(self, method: str) -> str:
        """The sign behind the title of a method that has a note, else nothing."""
        return f"({list(self.notes).index(method) + 1})" if method in self.notes else ""


RULE = (
    "A claim *holds* if its methods are lower on average and in most columns, the intervals mean ± standard deviation "
    f"of the averages do not overlap, there are at least {MIN_CHAINS} chains, and no prediction of these broke off. It "
    "*does not hold* if neither the average nor most columns are on its side; else it is *mixed*."
)
"""`Table._verdict` for people."""


def reached(
    targets: Sequence[Target],
    rows: Mapping[str, Row],
    columns: Sequence[str],
    unit: str,
    broken: Collection[tuple[str, str]] = (),
    quantity: str = "",
) -> list[Verdict]:
    """A verdict on each target of a quantity whose rows and columns are here.

    A target *holds* if it is reached by means plus standard deviations over `MIN_CHAINS` chains at least, and no
    prediction of its method broke off there. It is *mixed* if it is reached by the means alone, else it *does not
    hold*.

    Args:
        rows: errors by method.
        columns: those of the rows, in order.
        unit: of the errors.
        broken: (method, column) of predictions that broke off.
        quantity: as targets call it.
    """
    found = []
    for target in targets:
        if not (
            target.quantity == quantity
            and target.methods <= rows.keys()
            and set(target.columns) <= set(columns)
        ):
            continue
        chosen = target.columns or tuple(columns)
        index = [list(columns).index(column) for column in chosen]
        row, of = rows[target.method].over(index), rows[target.of].over(index) if target.of else None
        bound = target.most * (np.ones(len(index) + 1) if of is None else of.mean)
        spreads = np.zeros(len(index) + 1) if row.std is None else row.std
        kept = {"mean": row.mean <= bound, "surely": row.mean + spreads <= bound}
        if target.count is None:
            met, surely = (bool(inside[-1]) for inside in kept.values())
        else:
            met, surely = (bool(inside[:-1].sum() >= target.count) for inside in kept.values())
        doubts = [] if surely else ["not with the ±"]
        if len(row.runs) < MIN_CHAINS:
            doubts.append(f"{len(row.runs)} run{'s' if len(row.runs) > 1 else ''}, no spread to judge by")
        if away := [column for column in chosen if (target.method, column) in broken]:
            doubts.append(f"broke off in {len(away)} of {len(chosen)}")
        here = f"{spread(row)} {unit} ({row.title})"
        here += f" against {spread(of)} ({of.title})" if of else ""
        here += f", kept in {kept['mean'][:-1].sum()} of {len(index)}" if target.count is not None else ""
        word = FAILS if not met else MIXED if doubts else HOLDS
        found.append(
            Verdict(target, word, "; ".join([here, *doubts] if met else [here]), "not compared there")
        )
    return found


def shown(value: float, digits: int) -> str:
    """A number with some digits; one that would be zero is "< 0.01" (with two of them)."""
    text = f"{value:.{digits}f}"
    return text if float(text) else f"< {10**-digits:.{digits}f}"


def spread(row: Row) -> str:
    """The average of a row's columns with its standard deviation over the chains, if there are several."""
    return shown(row.mean[-1], 1) + ("" if row.std is None else f" ± {shown(row.std[-1], 1)}")


def chamfer_table(
    metrics: Mapping[str, Mapping[str, Sequence[Mapping]]],
    titles: Mapping[str, str],
    columns: Mapping[str, str],
    paper: PaperTable | None = None,
    notes: Mapping[str, str] | None = None,
    note: str | None = None,
) -> Table:
    """A table of tracer errors and distances. Any method may have a row; none is implied.

    Args:
        metrics: method -> scene or experiment -> content of its metrics.json, one a chain.
        titles: method -> name in the table, in the order of the rows.
        columns: scene or experiment -> heading, in order.
        paper: what to show beside it.
        notes: method -> what a reader must know of its numbers.
        note: what a reader must know of the whole table.

    Raises:
        InputError: a method lacks a column, or a column a finite value.
    """
    if not titles or not columns:
        raise InputError(
            "table: there are no methods, or no scenes and experiments; see tables in the configuration"
        )
    table = Table(dict(columns), paper, notes=notes or {}, note=note)

    def row(quantity: str, method: str, title: str) -> Row:
        chains = min(len(metrics.get(method, {}).get(column, ())) for column in columns)
        runs = [
            [_number(quantity, method, column, metrics[method][column][k]) for column in columns]
            for k in range(chains)
        ]
        if not runs:
            missing = next(column for column in columns if not metrics.get(method, {}).get(column))
            raise InputError(f"table: there is no metrics.json of {method} on {missing}")
        return Row(quantity, method, title, np.array(runs))

    for quantity in (*QUANTITIES, BROKEN):
        table.rows += [row(quantity, method, title) for method, title in titles.items()]
    floor = row("chamfer_floor", next(iter(titles)), "Sampling floor").runs[:1]
    table.rows.append(Row("chamfer_floor", "floor", "Sampling floor", floor))
    for method, title in titles.items():
        for column, heading in columns.items():
            runs = metrics[method][column]
            signs = TRAINING_DIVERGED if any(run.get("stable") is False for run in runs) else ""
            for k, run in enumerate(runs):
                if failure := run.get("diverged"):
                    signs += ROLLOUT_DIVERGED if ROLLOUT_DIVERGED not in signs else ""
                    chain = f", chain {k + 1} of {len(runs)}" if len(runs) > 1 else ""
                    table.failures.append(f"{title} on {heading}{chain}: {_told(failure, run)}")
            if signs:
                table.marks[method, column] = signs
    return table


def _told(failure: Mapping, run: Mapping) -> str:
    """What happened in a prediction that broke off, and when that began."""
    gain = run["energy_gain_after_step"]
    began = f"it had more energy than at the start after step {gain}"
    if gain is None:
        began = "no frame before had more energy than the start"
    what = f"particle {failure['particle']} {failure['happened']} at step {failure['step']} of {run['frames'][-1]}"
    return f"{what}; {began}."


def _number(quantity: str, method: str, column: str, run: Mapping) -> float:
    value = 100.0 * bool(run.get("diverged")) if quantity == BROKEN else run.get(quantity)
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(
            f"table: {quantity} of {method} on {column} is {value}; remove "
            f"{column}/{method}/metrics.json from the results and run again"
        )
    return float(value)
