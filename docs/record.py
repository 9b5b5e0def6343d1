"""Copy the tables and figures of a run to docs/results, and update the numbers on the pages that show them.

python -m docs.record            # after: snakemake --cores 2 tables figures random results/table1_converged.csv
python -m docs.record --configfile config/studies/three_chains.yaml     # after the same with this option

The first line of a recorded table names date, commit, grid and machine. `docs.recorded` writes its numbers into the
pages. The text `figures` of docs/results/figures.md is generated here, from files that are not copied.
"""

import argparse
import datetime
import platform
import shutil
import subprocess
from math import nan
from pathlib import Path
from statistics import mean, median

from PIL import Image

from docs.recorded import MADE_BY, filled, update
from neuma_lib.evaluation.text_tables import as_markdown
from neuma_lib.io.files import read_json
from neuma_lib.paper.figures import image_quality, lora_alphav, material_response
from neuma_lib.paper.image_grid import load_image_grid
from neuma_lib.project import loading

WIDTH = 1400  # of figures on a page [px]; in print they are larger


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


def grid(overlay: str | None) -> int:
    """Cells along an axis of the simulation of a run."""
    raw = loading.read_yaml("config/config.yaml")
    if overlay:
        raw = loading.merged(raw, loading.read_yaml(overlay))
    return loading.load(raw, ".").simulation.grid


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
    parser.add_argument(
        "--machine", default=f"2 cores of {processor()}, no GPU", help="what the run was computed on"
    )
    parser.add_argument(
        "--tables", nargs="*", default=tuple(MADE_BY), help="tables to copy; figures are always copied"
    )
    parser.add_argument("--commit", default=head(), help="code of the run")
    parser.add_argument("--configfile", help="settings of the run that lay over the defaults")
    parser.add_argument("--config", help="option --config of the run, such as 'random={seed: 12, count: 12}'")
    options = parser.parse_args()
    results, out = Path(options.results), Path("docs/results")
    settings = "default settings (`config/config.yaml`)"
    settings += f" with `{options.configfile}`" if options.configfile else ""
    today = datetime.date.today()
    origin = (
        f"{today}, commit {options.commit}, {grid(options.configfile)}³ cells, {options.machine}, {settings}"
    )
    given = f" --configfile {options.configfile}" if options.configfile else ""
    given += f" --config '{options.config}'" if options.config else ""
    command = f"snakemake{given} --" if given else "snakemake"
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
            small = image.convert("RGB").resize(size, Image.Resampling.LANCZOS)
        small.save(out / "figures" / picture.name, optimize=True)
    if numbers := figure_numbers(results / "figures"):
        page = out / "figures.md"
        page.write_text(filled(page.read_text(), "figures", numbers))
    update(Path())


if __name__ == "__main__":
    main()
