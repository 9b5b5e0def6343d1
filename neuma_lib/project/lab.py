"""A simulated lab: choose an experiment with an object, render it, identify all videos together, and repeat."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from neuma_lib.evaluation.next_page import describe
from neuma_lib.evaluation.text_tables import as_markdown
from neuma_lib.fitting.choose_next import read_fit
from neuma_lib.fitting.next_experiment import stds, undetermined
from neuma_lib.io.files import read_json, write_json, write_text
from neuma_lib.mechanics.combinations import constants_of, physical
from neuma_lib.project.project import Project
from neuma_lib.project.scaffold import next_scene

Make = Callable[[Sequence[Path], str], int]
"""Make a target with settings files on top of those of the project. Returns the exit status."""

PAGE = """\
# Experiments with {scene}, chosen one after the other

{end}

{table}

Standard deviations of the logarithms of the constants in percent: as predicted before the experiment, and as reported
by the joint identification after it. Then the error of the constants against the true ones, where the family is right.
"""


def run_lab(
    folder: Path, files: Sequence[Path], experiments: int, make: Make, log: Callable[[str], None]
) -> bool:
    """Repeat the choice until all constants are determined, or nothing more can be learned.

    The choice reads the results of identifications only, not the truth. Each launch is a scene with settings in
    config/, so that a lab that is interrupted continues. Writes lab.json and lab.md to the folder.

    Args:
        files: settings on top of those of the project.
        experiments: maximum number of experiments, with the existing one.
        make: runs the workflow.
        log: receives a line for each launch.

    Returns:
        Whether all targets were made.
    """
    scene, history = folder.name, folder / "lab.json"
    _, root = Project.find(folder, files)
    rounds: list[dict[str, Any]] = read_json(history) if history.is_file() else [{}]

    def made(name: str) -> bool:
        return make(given, (folder / name).relative_to(root).as_posix()) == 0

    while True:
        own = [root / each["file"] for each in rounds if "file" in each]
        given = [*(file for file in files if file not in own), *own]
        if not made("identified.json"):
            return False
        settings, _ = Project.find(folder, given)
        fit = read_fit(read_json(folder / "identified.json"), settings.identify)
        rounds[-1] |= {
            "family": fit.family.name,
            "reported": stds(fit, settings.identify),
            "constants": physical(fit.values),
        }
        write_json(history, rounds)
        if not undetermined(fit, settings.identify):
            end = "All constants are determined."
            break
        if len(rounds) >= experiments:
            end = f"The maximum of {experiments} experiments is reached."
            break
        if not made("next.md"):
            return False
        record = read_json(folder / "next.json")
        if not record["useful"]:
            end = "No candidate gains much, so nothing more can be learned within the limits of the lab."
            break
        best, name = record["candidates"][0], f"{scene}_next{len(rounds)}"
        file = next_scene(root, name, settings, folder)
        rounds.append({
            "file": file.relative_to(root).as_posix(),
            "experiment": describe(best),
            "predicted": best["expected"],
        })  # fmt: skip
        write_json(history, rounds)
        log(f"{name}: {describe(best)}")
    truth = physical(constants_of(settings.scene(scene).plain()["law"]))
    write_text(folder / "lab.md", PAGE.format(scene=scene, end=end, table=_table(rounds, truth)))
    log(end)
    return True


def _table(rounds: Sequence[dict[str, Any]], truth: dict[str, float]) -> str:
    """One row for each round."""
    rows = []
    for number, each in enumerate(rounds, 1):
        names = list(each["reported"])
        errors = [
            f"{100 * (each['constants'][name] / truth[name] - 1):+.0f}" if name in truth else ""
            for name in names
        ]
        rows.append([
            number,
            each.get("experiment", "the existing launch"),
            each["family"],
            ", ".join(names),
            ", ".join(f"{100 * each['predicted'][name]:.0f}" for name in names if name in each.get("predicted", {})),
            ", ".join(f"{100 * each['reported'][name]:.0f}" for name in names),
            ", ".join(errors),
        ])  # fmt: skip
    header = ["number", "experiment", "family", "constants", "predicted", "reported", "error"]
    return "\n".join(as_markdown(header, rows))
