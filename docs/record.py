"""Copy the tables and figures of a run to docs/results, and update the numbers on the pages that show them.

python -m docs.record            # after: snakemake --cores 2 tables figures random results/table1_converged.csv
python -m docs.record --configfile config/studies/three_chains.yaml     # after the same with this option

The first line of a recorded table names date, commit and machine. Text between `<!-- name -->` and `<!-- /name -->` is
generated: `table1` in README.md, `verdicts` in docs/results/claims.md, `figures` in docs/results/figures.md.
"""

from __future__ import annotations

import argparse
import datetime
import platform
import re
import shutil
import subprocess
from itertools import dropwhile, takewhile
from math import nan
from pathlib import Path
from statistics import mean, median

from PIL import Image

from neuma_lib.evaluation.text_tables import as_markdown
from neuma_lib.io.files import read_json
from neuma_lib.paper.claims import VERDICTS
from neuma_lib.paper.figures import image_quality, lora_alphav, material_response
from neuma_lib.paper.image_grid import load_image_grid
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
    "calibration": "calibration",
    "table1_systems": "results/table1_systems.csv",
    "table2_systems": "results/table2_systems.csv",
}
"""Tables that are recorded, and the target of Snakemake that makes them."""
VERDICT_HEAD = f"| {' | '.join(VERDICTS[:2])} |"
"""How the head of a table of verdicts begins."""

WIDTH = 1400
"""Of figures on a page [px]; in print they are larger."""


def processor() -> str:
    """Name of the processor, as Linux reports it."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor()


def head() -> str:
    """The commit that is checked out."""
    done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    return done.stdout.strip() or "unknown"


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


def fill(page: Path, name: str, content: str) -> None:
    """Replace the generated text `name` in a file."""
    page.write_text(filled(page.read_text(), name, content))


def overview(markdown: str) -> str:
    """The RMSE of a recorded table for the README: a mean for each column, the average with its spread."""
    origin = ", ".join(markdown.split(", ")[:2])
    lines = dropwhile(lambda line: not line.startswith("| Method |"), markdown.splitlines())
    head, _, *rows = (line[2:-2].split(" | ") for line in takewhile(bool, lines))
    last = head.index("Average")
    short = [
        [
            re.sub(r" \(\d+\)$", "", row[0]),
            *(re.sub(r" ± [\d.]+", "", cell) for cell in row[1:last]),
            row[last],
        ]
        for row in rows
    ]
    source = f"{origin}: [all columns, spreads and commands](docs/results/table1.md)."
    return "\n".join([*as_markdown(head[: last + 1], short, numbers=True), "", source])


def verdicts(tables: dict[str, str]) -> str:
    """Verdicts of the recorded tables as one Markdown table, and how much closer laws are than the true law.

    Tables that are not recorded, or recorded without verdicts, are listed.

    Args:
        tables: name -> its Markdown.
    """
    rows, absorbed = [], []
    for name, markdown in tables.items():
        link = f"[{name}]({name}.md)"
        lines = iter(markdown.splitlines())
        for line in lines:
            if line.startswith(VERDICT_HEAD):
                next(lines)  # the rule below the header
                for row in takewhile(lambda line: line.startswith("|"), lines):
                    cells = row[2:-2].split(" | ")
                    rows.append([link, *cells, *["not compared there"] * (len(VERDICTS) - len(cells))])
            elif line.startswith(ABSORBED):
                absorbed += ["", f"{link}: {line}"]
    header = ["table", *VERDICTS[:2], "here (RMSE in mm)", VERDICTS[3]]
    lacking = {
        "Not recorded": [f"{name} (`snakemake {MADE_BY[name]}`)" for name in MADE_BY if name not in tables],
        "Recorded by an older version, without verdicts": [
            name
            for name, text in tables.items()
            if name in PAPER and PAPER[name].claims and VERDICT_HEAD not in text
        ],
    }
    missing = [
        line for what, names in lacking.items() if names for line in ("", f"{what}: {', '.join(names)}.")
    ]
    return "\n".join([*as_markdown(header, rows), *absorbed, *missing])


def figure_numbers(folder: Path) -> str:
    """Numbers from the data of figures: quality of images, gradients, heights. Empty without data."""
    parts = []
    if (folder / "image_quality.json").exists():
        quality = read_json(folder / "image_quality.json")
        rows = [
            [title, *(f"{mean(quality[measure][method].values()):.3g}" for measure in image_quality.MEASURES)]
            for method, title in quality["titles"].items()
        ]
        seen = f" Training saw the views of {', '.join(quality['seen'])}." if quality["seen"] else ""
        parts += [
            f"Images in views that training did not see, mean over the scenes (`image_quality`).{seen}",
            "",
        ]
        parts += [*as_markdown(["Method", *image_quality.MEASURES.values()], rows, numbers=True), ""]
    if (folder / "gradient_analysis.json").exists():
        parts += ["Which network training turns to (`gradient_analysis`):", ""]
        rows = []
        for scene, analysis in read_json(folder / "gradient_analysis.json").items():
            norms = [f"{median(values):.2g}" for values in analysis["norms"].values()]
            rows.append(
                [scene, analysis["wrong"], *norms, *(f"{100 * c:.1f} %" for c in analysis["change"].values())]
            )
        names = "wrong in the prior", "gradient, elastic", "plastic", "change of weights, elastic", "plastic"
        parts += [*as_markdown(["Scene", *names], rows), ""]
    if (folder / "lora_alphav.h5").exists():
        numbers = load_image_grid(folder / "lora_alphav.h5").numbers
        inside = [k for k, weight in enumerate(numbers["weights"]) if 0 <= weight <= 1]
        counts = []
        for scene, film in numbers["scenes"].items():
            monotone, parted = lora_alphav.monotone_frames([film["heights"][k] for k in inside])
            counts.append(f"{monotone} of {parted} ({scene})")
        parts += [
            "Between w = 0 (prior) and 1 (trained law) the mean height is monotone in w in so many of the frames after "
            f"contact (`lora_alphav`): {', '.join(counts)}.",
            "",
        ]
    if (folder / "material_response.json").exists():
        responses = read_json(folder / "material_response.json")
        rows = [
            [
                responses["titles"][method],
                *(f"{100 * mean(parts.get(s, [nan])):.0f} %" for s in responses["scenes"]),
            ]
            for method, parts in material_response.covered(responses).items()
        ]
        if rows:
            about = (
                "Part of the visited points of response curves at which the truth lies in a law's 95 % band "
                "or, where it has none, in the range of its replicates"
            )
            parts += [f"{about} (`material_response`):", ""]
            parts += [*as_markdown(["Method", *responses["scenes"]], rows, numbers=True), ""]
    return "\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--results", default="results", help="folder of the run")
    parser.add_argument("--out", default="docs/results", help="folder to write to")
    parser.add_argument("--readme", default="README.md", help="page with the place table1")
    parser.add_argument(
        "--machine", default=f"2 cores of {processor()}, no GPU", help="what the run was computed on"
    )
    parser.add_argument(
        "--tables", nargs="*", default=tuple(MADE_BY), help="tables to copy; figures are always copied"
    )
    parser.add_argument("--commit", default=head(), help="code of the run")
    parser.add_argument("--configfile", help="settings of the run that lay over the defaults")
    options = parser.parse_args()
    results, out = Path(options.results), Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    origin = (
        f"{datetime.date.today()}, commit {options.commit}, {options.machine}, default settings (`config/config.yaml`)"
        + (f" with `{options.configfile}`" if options.configfile else "")
    )
    command = f"snakemake --configfile {options.configfile} --" if options.configfile else "snakemake"
    for name in options.tables:
        source = results / f"{name}.md"
        if source.exists():
            made = f"Made by `{command} {MADE_BY[name]}` and `python -m docs.record`."
            (out / f"{name}.md").write_text(f"{origin}. {made}\n\n{source.read_text()}")
            shutil.copyfile(source.with_suffix(".csv"), out / f"{name}.csv")
    for picture in sorted((results / "figures").glob("*.png")):
        (out / "figures").mkdir(exist_ok=True)
        with Image.open(picture) as image:
            size = WIDTH, round(image.height * WIDTH / image.width)
            small = image.convert("RGB").resize(size, Image.LANCZOS)
        small.save(out / "figures" / picture.name, optimize=True)

    recorded = {name: (out / f"{name}.md").read_text() for name in MADE_BY if (out / f"{name}.md").exists()}
    if "table1" in options.tables and (results / "table1.md").exists():
        fill(Path(options.readme), "table1", overview(recorded["table1"]))
    fill(out / "claims.md", "verdicts", verdicts(recorded))
    if numbers := figure_numbers(results / "figures"):
        fill(out / "figures.md", "figures", numbers)


if __name__ == "__main__":
    main()
