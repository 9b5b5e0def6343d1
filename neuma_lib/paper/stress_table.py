"""The table of stress errors: a section for each part of the stress, methods in rows, scenes in columns."""

from collections.abc import Mapping, Sequence

import numpy as np

from neuma_lib.evaluation.response import half_width, inside
from neuma_lib.evaluation.stress import PARTS
from neuma_lib.evaluation.text_tables import as_csv, as_markdown
from neuma_lib.paper.claims import Frame, Verdict, check, number, spread_note, verdict_lines
from neuma_lib.paper.published import BAND, OUTSIDE, PaperTable

HEADINGS = PARTS | {"asymmetric": "Antisymmetric part of the stress, which no material has"}
BANDS = {
    OUTSIDE: "Visited points at which the true response curve is outside the 95 % band of a law, in the worst test",
    BAND: "Half width of the 95 % band at the visited points relative to the true response curve, in the widest test",
}
"""Quantities of laws that have bands, and their headings."""


def stress_table(
    errors: Mapping[str, Mapping[str, Sequence[Mapping]]],
    titles: Mapping[str, str],
    columns: Mapping[str, str],
    paper: PaperTable,
    responses: Mapping[str, Mapping[str, Sequence[Mapping]]] | None = None,
) -> tuple[str, str, list[Verdict]]:
    """Relative errors of stresses in per cent.

    Args:
        errors: method -> scene -> results of `stress_errors`, one for each replicate.
        titles: method -> name in the table, in the order of the rows.
        columns: scene -> heading, in order.
        paper: heading and claims.
        responses: method -> scene -> results of `response` by name of the test, one for each replicate. Laws without
            bands have no row.

    Returns:
        CSV, with a row ``<part>_std`` after each row of means of several replicates; Markdown; verdicts on the claims.
    """
    replicates = min(len(runs) for row in errors.values() for runs in row.values())
    frame = Frame(dict(columns))
    for part in HEADINGS:
        for method, title in titles.items():
            runs = [[errors[method][c][k][part] for c in columns] for k in range(replicates)]
            # None, of broken paths, becomes NaN.
            frame.add(part, method, title, 100 * np.array(runs, dtype=float))
    for method, row in (responses or {}).items():
        runs = list(zip(*(row[column] for column in columns), strict=True))
        if all("band" in test for of_run in runs for tests in of_run for test in tests.values()):
            frame.add(OUTSIDE, method, titles[method], [list(map(_outside, of_run)) for of_run in runs])
            frame.add(BAND, method, titles[method], [list(map(_half_width, of_run)) for of_run in runs])
    verdicts = check(paper.claims, frame)
    lines = [["quantity", "method", "title", *columns, "Average"]]
    about = "Errors in per cent of the true stress, root mean squares over the true law's states on the reconstruction."
    text = [f"# {paper.heading}", "", about, ""]
    for part, heading in (HEADINGS | (BANDS if frame.of(OUTSIDE) else {})).items():
        lines += [cells for row in frame.of(part) for cells in row.csv_rows()]
        cells = [[row.title, *row.cells(1, number)] for row in frame.of(part)]
        if part == "stress":
            scales = [np.mean([run["true_rms"] for run in next(iter(errors.values()))[c]]) for c in columns]
            lines.append(["true_rms_pa", "truth", "True law", *(f"{scale:.4f}" for scale in scales), ""])
            scaled = (f"*{scale / 1e3:.3g}*" for scale in scales)
            cells.append(["*true stress, root mean square [kPa]*", *scaled, ""])
        header = ["Method", *columns.values(), "Average"]
        text += [f"**{heading}**", "", *as_markdown(header, cells, numbers=True), ""]
    if note := spread_note(replicates):
        text += [note, ""]
    broken = [
        f"- {titles[method]} on {columns[column]}: its stress became non-finite on {run['broken_paths']} paths, which "
        "are left out."
        for method, row in errors.items()
        for column, runs in row.items()
        for run in runs
        if run["broken_paths"]
    ]
    text += [*broken, ""] if broken else []
    text += verdict_lines(verdicts, "error here (%)", paper=True)
    return as_csv(lines), "\n".join(text), verdicts


def _outside(tests: Mapping[str, Mapping]) -> float:
    """Visited points of response curves outside a law's own band [%], in the worst test."""
    parts = [inside(test) for test in tests.values()]
    return max((100 * (1 - part) for part in parts if part is not None), default=np.nan)


def _half_width(tests: Mapping[str, Mapping]) -> float:
    """Half width of a law's own band relative to the true curve [%], in the widest test."""
    widths = [half_width(test) for test in tests.values()]
    return max((100 * width for width in widths if width is not None), default=np.nan)
