"""Numbers of the recorded tables on the pages. `python -m docs.recorded` writes them, a test compares them.

A number in a sentence stands in `<!-- TABLE METHOD COLUMN -->7.8 ± 0.9<!-- / -->`. TABLE is a CSV file in docs/results,
METHOD and COLUMN are words in it, and a fourth word is the quantity, by default the first of the table. Between
`<!-- table TABLE QUANTITY -->` and `<!-- /table -->` are all values of a quantity, and between `<!-- name -->` and
`<!-- /name -->` the text of one of `PLACES`.
"""

import csv
import re
from collections.abc import Iterator
from itertools import dropwhile, takewhile
from math import isfinite
from pathlib import Path
from statistics import median

from neuma_lib.evaluation.text_tables import as_markdown
from neuma_lib.paper.claims import FAILS, HOLDS, MIXED, RMSE, UNPUBLISHED, VERDICTS, shown
from neuma_lib.paper.published import PAPER
from neuma_lib.paper.tables import ABSORBED

MADE_BY = {
    "table1": "tables figures",
    "table2": "tables figures",
    "table3": "tables figures",
    "table4": "tables figures",
    "table5": "tables figures",
    "uneven_mass": "tables figures",
    "ablation_gradients": "tables figures",
    "table1_converged": "results/table1_converged.csv",
    "random": "random",
    "initial_states": "tables figures",
    "yardstick": "results/yardstick.csv",
    "stress": "results/stress.csv",
    "letters": "results/letters.csv",
    "views": "results/views.csv",
    "outside": "results/outside.csv",
    "identified": "results/identified.csv",
    "identified_table1_converged": "results/identified_table1_converged.csv",
    "calibration": "calibration",
    "piles": "results/piles.csv",
    "table1_systems": "results/table1_systems.csv",
    "table2_systems": "results/table2_systems.csv",
}
"""Tables that are recorded, and the target of Snakemake that makes them."""
VERDICT_HEAD = f"| {' | '.join(VERDICTS[:2])} |"  # how the head of a table of verdicts begins
METHODS = {
    "nclaw": "prior",
    "neuma": "NeuMA",
    "neuma_same_inputs": "NeuMA, inputs of constants",
    "constants": "constants",
    "neuma_structured": "structured",
    "true_law": "true law",
}
"""Columns of the summary."""
SUMMARY = (
    ("six scenes", "table1.md", ("table1", "yardstick"), "Average"),
    ("the same, converged truths", "table1_converged.md", ("table1_converged",), "Average"),
    ("random scenes", "random.md", ("random",), "Median"),
    ("letters N at 1 and 3 m/s", "letters.md", ("letters",), "Average"),
    ("outside: stiffening", "outside.md", ("outside",), "OutsideStiffening"),
    ("outside: rubber", "outside.md", ("outside",), "OutsideRubber"),
    ("outside: foam", "outside.md", ("outside",), "OutsideFoam"),
    ("outside: paste", "outside.md", ("outside",), "OutsidePaste"),
    ("outside: damp sand", "outside.md", ("outside",), "OutsideDampSand"),
    ("outside: fibres", "outside.md", ("outside",), "OutsideFibres"),
    (
        "six scenes at the paper's scale, 32³ cells",
        "paper_scale/README.md",
        ("paper_scale/table1",),
        "Average",
    ),
    (
        "the same, converged truths",
        "paper_scale/README.md",
        ("paper_scale/table1_converged",),
        "Average",
    ),
)
"""Rows of the summary: text, page, tables (the first of the same record that has a method is used), and column."""
END = "<!-- / -->"
NUMBER = re.compile(rf"(<!-- ([\w/]+ [^\s>]+ [^\s>]+(?: \w+)?) -->).*?({END})", re.DOTALL)
WHOLE_TABLE = re.compile(r"(<!-- table ([\w/]+) (\w+) -->\n).*?(<!-- /table -->)", re.DOTALL)


def filled(page: str, name: str, content: str) -> str:
    """A page with other content between `<!-- name -->` and `<!-- /name -->`.

    Raises:
        SystemExit: the page has not exactly one such place.
    """
    place = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
    page, count = place.subn(lambda match: f"{match[1]}{content.strip()}\n{match[2]}", page)
    if count != 1:
        raise SystemExit(f"a page has {count} places <!-- {name} --> ... <!-- /{name} -->; it needs one")
    return page


class Tables:
    """Recorded tables in a folder.

    Attributes:
        folder: docs/results.
        markdown: name -> Markdown of the tables of `MADE_BY` that it has.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        files = {name: folder / f"{name}.md" for name in MADE_BY}
        self.markdown = {name: file.read_text() for name, file in files.items() if file.exists()}

    def rows(self, table: str) -> dict[tuple[str, str], dict[str, str]]:
        """(quantity, method) -> column -> value of a CSV file. Empty without the file."""
        file = self.folder / f"{table}.csv"
        if not file.exists():
            return {}
        with file.open(encoding="utf-8", newline="") as lines:
            rows = list(csv.DictReader(lines))
        if rows and "quantity" in rows[0] and "method" in rows[0]:
            return {(row["quantity"], row["method"]): row for row in rows}
        methods = (
            [key.removesuffix("_rmse_mm") for key in rows[0] if key.endswith("_rmse_mm")] if rows else []
        )
        values = {
            m: {row["scene"]: row[f"{m}_rmse_mm"] for row in rows} for m in methods
        }  # a row for each scene
        return {
            (RMSE, m): {**column, "Median": str(median(map(float, column.values())))}
            for m, column in values.items()
        }

    def cell(self, table: str, method: str, column: str, quantity: str = "", digits: int = 1) -> str:
        """A mean with its spread over replicates, if there is one. † marks runs that diverged.

        Raises:
            KeyError: the table has no such value.
        """
        rows = self.rows(table)
        if not rows:
            raise KeyError(f"docs/results/{table}.csv")
        quantity = quantity or next(iter(rows))[0]
        row = rows[quantity, method]
        text = number(row[column], digits)
        if spread := rows.get((f"{quantity}_std", method), {}).get(column):
            text += f" ± {number(spread, digits)}"
        diverged = (row.get("diverged") or "").split()
        return text + "†" * (column in diverged or (column == "Average" and bool(diverged)))

    def place(self, words: str) -> str:
        """The value of a place in a sentence: table, method, column and perhaps quantity."""
        table, method, column, *quantity = words.split()
        return self.cell(table, method, column, "".join(quantity))

    def origin(self, table: str) -> str:
        """Commit and grid of a table, from the first line of its page."""
        first = self.markdown.get(table, "").partition("\n")[0]
        parts = re.search(r"commit (\w+)", first), re.search(r"(\d+³ cells)", first)
        return ", ".join(match[1] for match in parts if match)


def number(text: str, digits: int) -> str:
    """A value of a CSV file with fixed decimals. Texts that are no numbers are unchanged."""
    try:
        value = float(text)
    except ValueError:
        return text
    return shown(value, digits) if isfinite(value) else "–"


def summary(tables: Tables) -> str:
    """Average errors of the main methods in all recorded tables of motions."""
    rows = []
    for text, page, names, column in SUMMARY:
        cells = []
        for method in METHODS:
            same = (name for name in names if tables.origin(name) == tables.origin(names[0]))
            has = (name for name in same if (RMSE, method) in tables.rows(name))
            cells.append(tables.cell(name, method, column) if (name := next(has, None)) else "")
        if any(cells):
            seed = re.search(r", seed \d+", tables.markdown.get(names[0], "")) if column == "Median" else None
            text += f"{seed[0] if seed else ''}, median" if column == "Median" else ""
            rows.append([f"[{text}]({page})", *cells, tables.origin(names[0])])
    used = [0, *(k for k in range(1, len(METHODS) + 1) if any(row[k] for row in rows)), len(METHODS) + 1]
    head = ["", *METHODS.values(), "commit, grid"]
    return "\n".join(
        as_markdown([head[k] for k in used], [[row[k] for k in used] for row in rows], numbers=True)
    )


def overview(tables: Tables) -> str:
    """RMSE of Table 1 for the README, with its average on converged truths. Averages have their spread."""
    rows, reference = (error_rows(tables, name) for name in ("table1", "yardstick"))
    if "True law" in reference and tables.origin("yardstick") == tables.origin("table1"):
        rows["True law"] = reference["True law"]
    converged = error_rows(tables, "table1_converged")
    head = rows.pop("Method")
    last, last_converged = (row.index("Average") for row in (head, converged.pop("Method", head)))
    titles = sorted(dict.fromkeys([*converged, *rows]), key="True law".__eq__)
    short = []
    for title in titles:
        means = [re.sub(r" ± (< )?[\d.]+", "", cell) for cell in rows.get(title, [""] * last)[:last]]
        averages = [
            values.get(title, [""] * (place + 1))[place]
            for values, place in ((rows, last), (converged, last_converged))
        ]
        short.append([title, *means, *averages])
    sources = [
        f"[{text}](docs/results/{name}.md): commit {tables.origin(name)}"
        for name, text in (("table1", "six scenes"), ("table1_converged", "converged truths"))
        if name in tables.markdown
    ]
    header = ["Method", *head[:last], "Average", "Average, converged truths"]
    return "\n".join([*as_markdown(header, short, numbers=True), "", f"{'; '.join(sources)}."])


def error_rows(tables: Tables, name: str) -> dict[str, list[str]]:
    """Title -> cells of the first table of a page, with the header as "Method". Empty without the page."""
    lines = tables.markdown.get(name, "").splitlines()
    lines = takewhile(bool, dropwhile(lambda line: not line.startswith("| Method |"), lines))
    rows = [line[2:-2].split(" | ") for line in lines if not line.startswith("|---")]
    return {re.sub(r" \(\d+\)$", "", title): cells for title, *cells in rows}


def claims(tables: Tables) -> Iterator[list[str]]:
    """Rows of all tables of verdicts: table, claim, verdict, our numbers, the paper's."""
    for name, markdown in tables.markdown.items():
        lines = iter(markdown.splitlines())
        for line in lines:
            if line.startswith(VERDICT_HEAD):
                next(lines)  # the rule below the header
                for row in takewhile(lambda line: line.startswith("|"), lines):
                    cells = row[2:-2].split(" | ")
                    yield [name, *cells, *[UNPUBLISHED] * (len(VERDICTS) - len(cells))]


def verdicts(tables: Tables) -> str:
    """Verdicts of the recorded tables as one Markdown table, and how much closer laws are than the true law.

    Tables that are not recorded, or recorded without verdicts, are listed.
    """
    rows = [[f"[{name}]({name}.md)", *cells] for name, *cells in claims(tables)]
    absorbed = []
    for name, markdown in tables.markdown.items():
        about = [line for line in markdown.splitlines() if line.startswith(ABSORBED)]
        absorbed += [text for line in about for text in ("", f"[{name}]({name}.md): {line}")]
    header = ["table", *VERDICTS[:2], "here (RMSE in mm)", VERDICTS[3]]
    lacking = {
        "Not recorded": [
            f"{name} (`snakemake {MADE_BY[name]}`)" for name in MADE_BY if name not in tables.markdown
        ],
        "Recorded by an older version, without verdicts": [
            name
            for name, text in tables.markdown.items()
            if name in PAPER and PAPER[name].claims and VERDICT_HEAD not in text
        ],
    }
    missing = [
        line for what, names in lacking.items() if names for line in ("", f"{what}: {', '.join(names)}.")
    ]
    return "\n".join([*as_markdown(header, rows), *absorbed, *missing])


def verdicts_in_short(tables: Tables) -> str:
    """The claims by verdict, those of the paper first. Of the others, only those that do not hold are listed."""
    known = [(name, text, word.strip("*"), paper) for name, text, word, _, paper in claims(tables)]
    parts = []
    for heading, of_paper in (("Comparisons that the paper prints", True), ("Further comparisons", False)):
        rows = [claim for claim in known if (claim[3] != UNPUBLISHED) == of_paper]
        parts += [f"{heading}:", ""]
        for word in (HOLDS, MIXED, FAILS):
            texts = [f"{text} ([{name}]({name}.md))" for name, text, verdict, _ in rows if verdict == word]
            listed = f": {'; '.join(texts)}" if texts and (of_paper or word != HOLDS) else ""
            parts += [f"- **{word}**, {len(texts)} of {len(rows)}{listed}"]
        parts += [""]
    return "\n".join(parts)


def whole_table(tables: Tables, table: str, quantity: str) -> str:
    """All methods and columns of one quantity."""
    rows = {method: row for (own, method), row in tables.rows(table).items() if own == quantity}
    first = next(iter(rows.values()))
    columns = [
        name for name in first if name not in ("quantity", "method", "title", "Median", "wins", "diverged")
    ]
    cells = [
        [row["title"], *(tables.cell(table, method, column, quantity) for column in columns)]
        for method, row in rows.items()
    ]
    return "\n".join(as_markdown(["", *columns], cells, numbers=True))


def pages(root: Path) -> dict[Path, str]:
    """Pages whose generated places differ from docs/results -> their text with the recorded numbers.

    Raises:
        SystemExit: a place names a table, method or column that is not recorded.
    """
    tables, texts = Tables(root / "docs/results"), {}
    for page in [root / "README.md", *sorted((root / "docs").rglob("*.md"))]:
        text = page.read_text()
        if len(NUMBER.findall(text)) != text.count(END):
            raise SystemExit(f"{page}: {END} needs <!-- TABLE METHOD COLUMN --> before its number")
        try:
            new = NUMBER.sub(lambda match: match[1] + tables.place(match[2]) + match[3], text)
            new = WHOLE_TABLE.sub(
                lambda match: f"{match[1]}{whole_table(tables, match[2], match[3])}\n{match[4]}", new
            )
        except KeyError as error:
            raise SystemExit(
                f"{page}: docs/results has no {error.args[0]}, which a place <!-- ... --> names"
            ) from None
        for name, place in PLACES.items():
            if page == root / place[0]:
                new = filled(new, name, place[1](tables))
        if new != text:
            texts[page] = new
    return texts


PLACES = {
    "table1": ("README.md", overview),
    "summary": ("docs/results/README.md", summary),
    "verdicts_in_short": ("docs/results/README.md", verdicts_in_short),
    "verdicts": ("docs/results/claims.md", verdicts),
}
"""Name of a generated text -> its page, and the function of the tables that writes it."""


def update(root: Path) -> None:
    """Write the recorded numbers into the pages of a checkout."""
    for page, text in pages(root).items():
        page.write_text(text)


if __name__ == "__main__":
    update(Path())
