"""Copy tables and figures of a run to docs/results, and fill the numbers of README.md and docs/results/README.md.

python -m docs.record            # after: snakemake --cores 2 tables figures

A table gets the machine, the commit and the date in its first line. On the two pages everything between `<!-- name -->`
and `<!-- /name -->` is replaced by what is in the recorded tables and in the data of the figures; no verdict and no
number in there is written by hand.
"""

from __future__ import annotations

import argparse
import datetime
import platform
import re
import shutil
import subprocess
from pathlib import Path
from statistics import mean, median

from PIL import Image

from neuma_lib.evaluation.figures import image_quality, lora_alphav
from neuma_lib.evaluation.plotting.image_grid import load_image_grid
from neuma_lib.evaluation.reports import as_markdown
from neuma_lib.evaluation.tables import VERDICTS
from neuma_lib.io.files import read_json

TABLES = (
    "table1",
    "table2",
    "table3",
    "table4",
    "table5",
    "uneven_mass",
    "ablation_gradients",
    "without_binding",
    "initial_states",
    "timings",
    "learning_rates",
)

WIDTH = 1400
"""Of figures on a page [px]; in print they are larger."""


def processor() -> str:
    """Name of the processor, as Linux tells it."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor()


def head() -> str:
    """The commit that is checked out."""
    found = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    return found.stdout.strip() or "unknown"


def filled(page: str, name: str, content: str) -> str:
    """A page with other content between `<!-- name -->` and `<!-- /name -->`.

    Raises:
        SystemExit: the page has not exactly one such place.
    """
    place = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.DOTALL)
    page, count = place.subn(lambda found: f"{found[1]}{content.strip()}\n{found[2]}", page)
    if count != 1:
        raise SystemExit(f"a page has {count} places <!-- {name} --> ... <!-- /{name} -->; it needs one")
    return page


def without_heading(markdown: str) -> str:
    """A recorded table without its heading: where it is from becomes the last paragraph."""
    origin, _, table = markdown.partition("\n\n")
    return re.sub("^# .*\n+", "", table).strip() + f"\n\n{origin}"


def verdicts(tables: dict[str, str]) -> str:
    """The verdicts of all recorded tables as one Markdown table; `tables`: name -> its Markdown."""
    header = f"| {' | '.join(VERDICTS)} |"
    rows = []
    for name, markdown in tables.items():
        lines = iter(markdown.splitlines())
        if header in lines:
            next(lines)  # the rule below the header
            for line in lines:
                if not line.startswith("|"):
                    break
                rows.append([f"[{name}]({name}.md)", *line.strip("| ").split(" | ", len(VERDICTS) - 1)])
    return "\n".join(as_markdown(["table", *VERDICTS], rows))


def figure_numbers(folder: Path) -> str:
    """What the data of figures say in numbers: qualities of images, gradients, heights; empty where there are none."""
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
        for scene, found in read_json(folder / "gradient_analysis.json").items():
            norms = [f"{median(values):.2g}" for values in found["norms"].values()]
            rows.append(
                [scene, found["wrong"], *norms, *(f"{100 * c:.1f} %" for c in found["change"].values())]
            )
        names = "wrong in the prior", "gradient, elastic", "plastic", "change of weights, elastic", "plastic"
        parts += [*as_markdown(["Scene", *names], rows), ""]
    if (folder / "lora_alphav.h5").exists():
        numbers = load_image_grid(folder / "lora_alphav.h5").numbers
        inside = [k for k, weight in enumerate(numbers["weights"]) if 0 <= weight <= 1]
        counts = []
        for scene, found in numbers["scenes"].items():
            monotone, parted = lora_alphav.monotone_frames([found["heights"][k] for k in inside])
            counts.append(f"{monotone} of {parted} ({scene})")
        parts += [
            "Between w = 0 (prior) and 1 (trained law) the mean height is monotone in w in so many of the frames after "
            f"contact (`lora_alphav`): {', '.join(counts)}.",
            "",
        ]
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
        "--tables", nargs="*", default=TABLES, help="tables to copy; figures are always copied"
    )
    parser.add_argument("--commit", default=head(), help="code of the run")
    options = parser.parse_args()
    results, out = Path(options.results), Path(options.out)
    out.mkdir(parents=True, exist_ok=True)
    origin = (
        f"{datetime.date.today()}, commit {options.commit}, {options.machine},"
        " default settings (`config/config.yaml`). Made by `snakemake tables figures` and `python -m docs.record`."
    )
    for name in options.tables:
        source = results / f"{name}.md"
        if source.exists():
            (out / f"{name}.md").write_text(f"{origin}\n\n{source.read_text()}")
            shutil.copyfile(source.with_suffix(".csv"), out / f"{name}.csv")
    for picture in sorted((results / "figures").glob("*.png")):
        (out / "figures").mkdir(exist_ok=True)
        with Image.open(picture) as image:
            size = WIDTH, round(image.height * WIDTH / image.width)
            small = image.convert("RGB").resize(size, Image.LANCZOS)
        small.save(out / "figures" / picture.name, optimize=True)

    recorded = {name: (out / f"{name}.md").read_text() for name in TABLES if (out / f"{name}.md").exists()}
    readme, page = Path(options.readme), out / "README.md"
    if "table1" in options.tables and (results / "table1.md").exists():
        readme.write_text(filled(readme.read_text(), "table1", without_heading(recorded["table1"])))
    text = filled(page.read_text(), "verdicts", verdicts(recorded))
    if numbers := figure_numbers(results / "figures"):
        text = filled(text, "figures", numbers)
    page.write_text(text)


if __name__ == "__main__":
    main()
