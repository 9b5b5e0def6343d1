"""Claims about methods, and their verdicts.

A claim is a statement and a rule that checks it with a `Frame`, the errors of a run. The error is tracer RMSE, which
measures all motion and has no sampling floor. The paper gives Chamfer distances only.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from neuma_lib.evaluation.text_tables import as_markdown

RMSE = "tracer_rmse_mm"  # quantity that claims are checked with, unless they name another
PRINTED = "chamfer_paper"  # Chamfer distances in the paper. NaN for columns that the paper does not have.
BROKEN = "broke_off"  # runs whose prediction stopped early [%]
MIN_REPLICATES = 3  # number of replicates that a standard deviation needs to support a claim

HOLDS, MIXED, FAILS = "holds", "mixed", "does not hold"
UNPUBLISHED = "not compared there"
VERDICTS = ("claim", "verdict", "RMSE here (mm)", "Chamfer distance in the paper")
"""Columns of the table of verdicts."""
RULE = (
    "A claim *holds* if its methods are lower on average and in most columns, the intervals mean ± standard deviation "
    f"of the averages do not overlap, there are at least {MIN_REPLICATES} replicates, no prediction of these "
    "broke off, and all this is so without the columns in which a training of the others diverged. It *does not hold* "
    "if neither the average nor most columns support it, else it is *mixed*."
)
"""Explanation of `Closer`, in its documentation and for readers of a table."""


@dataclass(frozen=True)
class Row:
    """Values of one quantity and method, shape (replicates, columns). Columns are scenes or experiments."""

    quantity: str
    method: str
    title: str
    runs: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """Mean of each column over the replicates, then the average over all columns, shape (C + 1,)."""
        return self._averaged().mean(axis=0)

    @property
    def std(self) -> np.ndarray | None:
        """Standard deviations over the replicates, also of the average, (C + 1,). None for a single replicate."""
        return self._averaged().std(axis=0, ddof=1) if len(self.runs) > 1 else None

    @property
    def median(self) -> float:
        """Median over all runs."""
        return float(np.median(self.runs))

    def csv_rows(self) -> list[list[str]]:
        """CSV cells of the means and, for several replicates, of the standard deviations."""
        return [
            [self.quantity + suffix, self.method, self.title, *(number(v, 4) for v in values)]
            for suffix, values in (("", self.mean), ("_std", self.std))
            if values is not None
        ]

    def cells(self, digits: int, text: Callable[[float, int], str]) -> list[str]:
        """Markdown cells: each mean as text, with ± the standard deviation for several replicates."""
        spreads = [""] * len(self.mean) if self.std is None else [f" ± {shown(s, digits)}" for s in self.std]
        means = zip(self.mean, spreads, strict=True)
        return [text(v, digits) + (spread if np.isfinite(v) else "") for v, spread in means]

    def text(self, unit: str = "") -> str:
        """Average over the columns, with its standard deviation for several replicates, and the title."""
        return f"{self.cells(1, shown)[-1]}{unit} ({self.title})"

    def _averaged(self) -> np.ndarray:
        return np.concatenate([self.runs, self.runs.mean(axis=1, keepdims=True)], axis=1)


def shown(value: float, digits: int) -> str:
    """A number with fixed decimals. Those that would round to zero are "< 0.01" (for two digits)."""
    text = f"{value:.{digits}f}"
    return text if float(text) else f"< {10**-digits:.{digits}f}"


def number(value: float, digits: int) -> str:
    """A number with fixed decimals, or a dash for NaN."""
    return f"{value:.{digits}f}" if np.isfinite(value) else "–"


def spread_note(replicates: int) -> str:
    """Explanation of ± in cells. Empty for a single replicate."""
    note = f"± is the standard deviation over {replicates} replicates; after an average, of their averages."
    return note if replicates > 1 else ""


@dataclass
class Frame:
    """Values by quantity, method, column and replicate."""

    columns: dict[str, str]  # name of each scene or experiment -> heading
    # (quantity, method) -> values, in the order of the tables
    rows: dict[tuple[str, str], Row] = field(default_factory=dict)
    # (method, column) of predictions that stopped early
    broken: set[tuple[str, str]] = field(default_factory=set)
    diverged: set[tuple[str, str]] = field(default_factory=set)  # (method, column) of trainings that diverged

    def add(self, quantity: str, method: str, title: str, runs: Sequence[Sequence[float]]) -> None:
        """Add the values of a quantity and method, (replicates, columns)."""
        self.rows[quantity, method] = Row(quantity, method, title, np.array(runs, dtype=float))

    def of(self, quantity: str) -> list[Row]:
        """Rows of all methods."""
        return [row for row in self.rows.values() if row.quantity == quantity]

    def select(self, quantity: str, methods: Iterable[str], columns: Sequence[str]) -> list[Row] | None:
        """Rows of some methods in some columns (all if empty). None if the frame lacks a row or column."""
        rows, names = [self.rows.get((quantity, method)) for method in methods], list(self.columns)
        if any(row is None for row in rows) or not set(columns) <= set(names):
            return None
        index = [names.index(column) for column in columns or names]
        return [Row(row.quantity, row.method, row.title, row.runs[:, index]) for row in rows]


@dataclass(frozen=True)
class Verdict:
    """Result of checking a claim."""

    text: str  # the claim
    word: str  # "holds", "mixed" or "does not hold"
    here: str  # our numbers, and what keeps the claim from holding
    paper: str = UNPUBLISHED  # the paper's Chamfer distances, or why there are none

    def __str__(self) -> str:
        return f"{self.word.capitalize()}: {self.text}. {self.here}."


@dataclass(frozen=True)
class Closer:
    """Some methods are closer to the truth than others, by `RULE`.

    For three replicates of equal spread, no overlap of the intervals means t > 2.4, which occurs by chance in 4 of 100
    cases. Predictions that stop early do not count because their error is too small. "No worse" is checked like
    "closer", since a difference that is not seen may still exist.
    """

    text: str  # the claim
    # better, worse: methods. The worst of the first is compared with the best of the second.
    better: tuple[str, ...]
    worse: tuple[str, ...]
    columns: tuple[str, ...] = ()  # scenes or experiments; all columns if empty
    by_paper: bool = True  # whether the paper makes the comparison

    @property
    def methods(self) -> set[str]:
        return {*self.better, *self.worse}

    def holds(self, frame: Frame) -> Verdict | None:
        better, worse = (frame.select(RMSE, group, self.columns) for group in (self.better, self.worse))
        if better is None or worse is None:
            return None
        high, low = max(better, key=lambda r: r.mean[-1]), min(worse, key=lambda r: r.mean[-1])
        average = bool(high.mean[-1] < low.mean[-1])
        first, second = (np.stack([row.mean[:-1] for row in rows]) for rows in (better, worse))
        lower, count = int((first.max(axis=0) < second.min(axis=0)).sum()), first.shape[1]
        majority = 2 * lower > count
        few = _too_few(*better, *worse)
        overlap = (
            average
            and not few
            and max(r.mean[-1] + r.std[-1] for r in better) >= min(r.mean[-1] - r.std[-1] for r in worse)
        )
        broke = any((m, c) in frame.broken for m in self.better for c in self.columns or frame.columns)
        caveats = {
            "not on average": not average,
            "not in most columns": not majority,
            few: few,
            "the ± overlap": overlap,
            "a prediction broke off": broke,
        }
        reasons = [text for text, applies in caveats.items() if applies]
        if not (reasons or self._holds_without_diverged(frame)):
            reasons = ["not without the columns in which a training diverged"]
        here = f"{high.text()} against {low.text()}, lower in {lower} of {count}"
        if not (average or majority):
            return Verdict(self.text, FAILS, here, self._paper(frame))
        here += f"; {', '.join(reasons)}" if reasons else ""
        return Verdict(self.text, MIXED if reasons else HOLDS, here, self._paper(frame))

    def _holds_without_diverged(self, frame: Frame) -> bool:
        """Whether the claim depends on no column in which a training of the worse methods diverged."""
        columns = self.columns or tuple(frame.columns)
        sound = tuple(c for c in columns if not any((method, c) in frame.diverged for method in self.worse))
        verdict = replace(self, columns=sound).holds(frame) if sound and sound != columns else None
        return sound == columns or (verdict is not None and verdict.word == HOLDS)

    def _paper(self, frame: Frame) -> str:
        """The same comparison with the paper's distances."""
        if not self.by_paper:
            return UNPUBLISHED
        groups = [frame.select(PRINTED, group, self.columns) for group in (self.better, self.worse)]
        if None in groups:
            return ""
        first, second = ([row.mean[-1] for row in group] for group in groups)
        return f"{max(first):.2f} against {min(second):.2f}" if np.isfinite([*first, *second]).all() else ""


@dataclass(frozen=True)
class Bound:
    """A bound on the error of a method.

    The claim *holds* if means plus standard deviations over at least `MIN_REPLICATES` replicates are within the bound,
    and no prediction of the method stopped early. It is *mixed* if the means alone are, else it *does not hold*.
    """

    text: str  # the claim
    method: str  # whose error is bounded
    limit: float  # the bound in the unit of the quantity, or in multiples of the error of the method ``of``
    of: str = ""  # the method to compare with in the same column; none if empty
    # number of columns that must be within the bound. None: the average over the columns must be.
    count: int | None = None
    columns: tuple[str, ...] = ()  # scenes or experiments; all columns if empty
    quantity: str = RMSE  # quantity that is bounded
    also: tuple[str, str] | None = None  # name and quantity [%] of the method that the verdict states, too

    @property
    def methods(self) -> set[str]:
        return {self.method, self.of} - {""}

    def holds(self, frame: Frame) -> Verdict | None:
        rows = frame.select(self.quantity, [self.method, *([self.of] if self.of else [])], self.columns)
        if rows is None:
            return None
        row, *of = rows
        bound = self.limit * (of[0].mean if of else np.ones(len(row.mean)))
        within = row.mean <= bound
        surely = within if row.std is None else row.mean + row.std <= bound
        met, sure = (ok[-1] if self.count is None else ok[:-1].sum() >= self.count for ok in (within, surely))
        reasons = [] if sure else ["not with the ±"]
        reasons += filter(None, [_too_few(row)])
        columns = self.columns or tuple(frame.columns)
        broke = sum((self.method, column) in frame.broken for column in columns)
        if broke and self.quantity != BROKEN:
            reasons.append(f"broke off in {broke} of {len(columns)}")
        here = row.text(" mm" if self.quantity == RMSE else " %")
        here += f" against {of[0].text()}" if of else ""
        here += f", kept in {within[:-1].sum()} of {len(columns)}" if self.count is not None else ""
        if self.also and (other := frame.select(self.also[1], [self.method], self.columns)):
            here += f", {self.also[0]} {other[0].cells(1, shown)[-1]} %"
        word = FAILS if not met else MIXED if reasons else HOLDS
        return Verdict(self.text, word, "; ".join([here, *reasons]) if word == MIXED else here)


Claim = Closer | Bound
"""Claims that a frame of errors is checked with. ``holds`` returns None if the frame lacks a row or column."""


def counted(
    text: str, met: Sequence[bool], share: float, what: str, numbers: str = "", whole: str = ""
) -> Verdict:
    """A claim about a share of independent trials, which holds if enough of them meet it.

    Args:
        text: the claim, followed by the number of trials that it needs.
        met: whether each trial meets it.
        share: of the trials that must meet it.
        whole: text instead of "at least n" if all trials are needed.
    """
    needed, count, total = math.ceil(share * len(met)), sum(met), len(met)
    amount = whole if whole and needed == total else f"at least {needed}"
    here = ", ".join(filter(None, [f"{count} of {total}", numbers]))
    return Verdict(f"{text} {amount} of {total} {what}", HOLDS if total and count >= needed else FAILS, here)


def check(claims: Iterable[Claim], frame: Frame) -> list[Verdict]:
    """Verdicts on the claims whose rows and columns the frame has."""
    return [verdict for claim in claims if (verdict := claim.holds(frame))]


def verdict_lines(verdicts: Sequence[Verdict], here: str = "here", paper: bool = False) -> list[str]:
    """Markdown lines of a table of verdicts, with a heading. Nothing for no verdicts."""
    if not verdicts:
        return []
    rows = [[v.text, f"**{v.word}**", v.here, *([v.paper] if paper else [])] for v in verdicts]
    head = [*VERDICTS[:2], here, *([VERDICTS[3]] if paper else [])]
    return ["**What holds**", "", *as_markdown(head, rows), ""]


def _too_few(*rows: Row) -> str:
    """A remark if a row has less than `MIN_REPLICATES` replicates, else nothing."""
    fewest = min(len(row.runs) for row in rows)
    return "" if fewest >= MIN_REPLICATES else f"{fewest} run{'s' if fewest > 1 else ''}, no spread"
