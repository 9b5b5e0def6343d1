"""Plain tables as CSV and Markdown."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def as_csv(rows: Iterable[Iterable[Any]]) -> str:
    """Lines of comma-separated values."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


def as_markdown(header: Sequence[Any], rows: Iterable[Iterable[Any]], numbers: bool = False) -> list[str]:
    """Lines of a Markdown table. With ``numbers``, all columns but the first are right-aligned."""
    rule = "---:|" if numbers else "---|"
    lines = [f"| {' | '.join(map(str, cells))} |" for cells in (header, *rows)]
    return [lines[0], f"|---|{rule * (len(header) - 1)}", *lines[1:]]


def report_table(
    rows: Mapping[str, Mapping[str, float]], columns: Mapping[str, str], corner: str
) -> tuple[str, str]:
    """A table of numbers as CSV and as Markdown.

    Args:
        rows: row name -> quantity -> value.
        columns: quantity -> heading in the Markdown table, in order.
        corner: heading of the first column.
    """
    values = [[name, *(row[key] for key in columns)] for name, row in rows.items()]
    cells = [[v if isinstance(v, int | str) else f"{v:.4g}" for v in row] for row in values]
    lines = as_markdown([corner, *columns.values()], cells, numbers=True)
    return as_csv([[corner, *columns], *values]), "\n".join(lines) + "\n"
