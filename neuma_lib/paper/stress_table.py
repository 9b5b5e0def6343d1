"""The table of stress errors: a part of the stress at a time, methods in rows, scenes in columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from neuma_lib.evaluation.response import inside
from neuma_lib.evaluation.stress import PARTS
from neuma_lib.evaluation.text_tables import as_csv, as_markdown
from neuma_lib.paper.published import OUTSIDE, PaperTable
from neuma_lib.paper.tables import VERDICTS, Row, Verdict, reached, shown

ASYMMETRIC = "asymmetric"
HEADINGS = PARTS | {ASYMMETRIC: "Antisymmetric part of the stress, which no material has"}
OUTSIDE_HEADING = (
    "Visited points at which the true response curve is outside the 95 % band of a law, in the worst test"
)


def stress_table(
    errors: Mapping[str, Mapping[str, Sequence[Mapping]]],
    titles: Mapping[str, str],
    columns: Mapping[str, str],
    paper: PaperTable,
    responses: Mapping[str, Mapping[str, Sequence[Mapping]]] | None = None,
) -> tuple[str, str, list[Verdict]]:
    """Relative errors of stresses in per cent.

    Args:
        errors: method -> scene -> what `stress_errors` gave, one a chain.
        titles: method -> name in the table, in the order of the rows.
        columns: scene -> heading, in order.
        paper: heading and targets.
        responses: method -> scene -> what `response` gave by the name of the test, one a chain; laws without bands have
            no row.

    Returns:
        CSV, with a row ``<part>_std`` behind each row of means over several chains; Markdown; verdicts on the targets.
    """
    chains = min(len(runs) for row in errors.values() for runs in row.values())

    def row(part: str, method: str, title: str) -> Row:
        runs = [[errors[method][c][k][part] for c in columns] for k in range(chains)]
        return Row(
            part, method, title, 100 * np.array(runs, dtype=float)
        )  # None, of broken paths, is not a number

    rows = {part: {m: row(part, m, title) for m, title in titles.items()} for part in HEADINGS}
    rows[OUTSIDE] = _outside(responses or {}, titles, columns)
    verdicts = reached(paper.targets, rows["stress"], list(columns), "%")
    verdicts += reached(paper.targets, rows[OUTSIDE], list(columns), "%", quantity=OUTSIDE)
    lines = [["quantity", "method", "title", *columns, "Average"]]
    about = (
        "Errors in per cent of the true stress, root mean squares over states that the true law goes through"
    )
    text = [f"# {paper.heading}", "", f"{about} on the reconstruction.", ""]
    for part, heading in (HEADINGS | ({OUTSIDE: OUTSIDE_HEADING} if rows[OUTSIDE] else {})).items():
        cells = []
        for each in rows[part].values():
            for suffix, values in ("", each.mean), ("_std", each.std):
                if values is not None:
                    lines.append(
                        [part + suffix, each.method, each.title, *(_number(v, ".4f") for v in values)]
                    )
            spreads = [""] * len(each.mean) if each.std is None else [f" ± {shown(s, 1)}" for s in each.std]
            cells.append([
                each.title,
                *(_number(v, ".1f") + (s if np.isfinite(v) else "") for v, s in zip(each.mean, spreads, strict=True)),
            ])  # fmt: skip
        if part == "stress":
            scales = [np.mean([run["true_rms"] for run in next(iter(errors.values()))[c]]) for c in columns]
            lines.append(["true_rms_pa", "truth", "True law", *(f"{scale:.4f}" for scale in scales), ""])
            cells.append(
                ["*true stress, root mean square [kPa]*", *(f"*{scale / 1e3:.3g}*" for scale in scales), ""]
            )
        text += [
            f"**{heading}**",
            "",
            *as_markdown(["Method", *columns.values(), "Average"], cells, True),
            "",
        ]
    if chains > 1:
        text += [
            f"± is the standard deviation over {chains} chains; behind an average, of their averages.",
            "",
        ]
    if told := _broken(errors, titles, columns):
        text += [*(f"- {line}" for line in told), ""]
    if verdicts:
        cells = [[v.claim.text, f"**{v.word}**", v.here, v.paper] for v in verdicts]
        header = [*VERDICTS[:2], "error here (%)", VERDICTS[3]]
        text += ["**What holds**", "", *as_markdown(header, cells), ""]
    return as_csv(lines), "\n".join(text), verdicts


def _number(value: float, digits: str) -> str:
    return format(value, digits) if np.isfinite(value) else "–"


def _outside(responses: Mapping, titles: Mapping[str, str], columns: Mapping[str, str]) -> dict[str, Row]:
    """Rows of `OUTSIDE` of the laws that have bands, every chain judged by its own band."""

    def outside(tests: Mapping[str, Mapping]) -> float:
        parts = [inside(test) for test in tests.values()]
        return max((100 * (1 - part) for part in parts if part is not None), default=np.nan)

    found = {}
    for method, row in responses.items():
        chains = list(zip(*(row[column] for column in columns), strict=True))
        if all("band" in test for chain in chains for tests in chain for test in tests.values()):
            runs = [[outside(tests) for tests in chain] for chain in chains]
            found[method] = Row(OUTSIDE, method, titles[method], np.array(runs))
    return found


def _broken(errors: Mapping, titles: Mapping[str, str], columns: Mapping[str, str]) -> list[str]:
    """Where the stress of a law became non-finite on a path, a sentence each."""
    return [
        f"{titles[method]} on {columns[column]}: its stress became non-finite on {run['broken_paths']} paths, which "
        "are left out."
        for method, row in errors.items()
        for column, runs in row.items()
        for run in runs
        if run["broken_paths"]
    ]
