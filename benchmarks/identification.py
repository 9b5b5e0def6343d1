"""Identification compared with known truths: constants with their uncertainty, choice of family, motion, time.

    python -m benchmarks.identification RubberPawn                          # reads data/, results/, config/config.yaml
    python -m benchmarks.identification random1_05 random2_03 --seeds 1 2 --count 12 --jobs 16 --out identified.json
    python -m benchmarks.identification random1_05 --set '{"prune_factor": 3}'   # other settings of `identify`

A scene may be named by the beginning of its name. Without names, all random scenes with results are used.
Dataset and reconstruction must exist (`snakemake results/SCENE/velocity.json`). Only the
comparison reads the truth. Settings are to be tuned on draws that are not reported.
"""

import json
import math
import multiprocessing
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import torch

from benchmarks.project_scenes import (
    chosen_scenes,
    prior_of,
    read_body,
    refined_bodies,
    scene_parser,
    simulator,
    true_tracers,
)
from benchmarks.timing import core_seconds
from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.evaluation.metrics import tracer_errors
from neuma_lib.fitting.identified import Identified
from neuma_lib.fitting.identify import identify
from neuma_lib.io.files import write_json
from neuma_lib.io.images import load_observation
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.combinations import constants_of, physical
from neuma_lib.paper.identified_table import MATERIAL, compare_family, compare_quantities, right_families
from neuma_lib.project.loading import merged
from neuma_lib.project.settings import Config
from neuma_lib.sim.prediction import predict

COVERED = 2.0  # standard deviations
CLOSE = 0.1  # relative error


def evaluate(job: tuple[str, Config, Mapping[str, Any]]) -> dict[str, Any]:
    """Identify one scene with changed settings and compare with its truth; plain numbers."""
    name, settings, changes = job
    torch.set_num_threads(1)
    scene, data = settings.scene(name), Path(settings.data_root) / name
    chosen = IdentifyConfig(**merged(settings.identify_of(name).plain(), changes))
    body, motion = read_body(name, settings, chosen)
    video = load_observation(data / "dynamic/transforms.json", chosen.views).to(torch.float32)
    refined = refined_bodies(name, settings, chosen, body)
    model = simulator(settings, scene)
    before = core_seconds()
    identified = identify(model, motion, body, video, chosen, prior_of(settings, scene), refined=refined)
    seconds = core_seconds() - before
    truth = scene.law.plain()
    record = identified.as_dict()
    row = {
        "scene": name,
        "truth": truth,
        "core_seconds": seconds,
        "family_is": compare_family(record, truth) if right_families(record, truth) else None,
        "quantities": compare_quantities(record, truth),
        "material": compare_quantities(record, truth, MATERIAL),
        "combinations": _combinations(identified, truth),
        "found": record,
    }
    tracers = true_tracers(settings, name)[0].to(body.x0)
    laws = {"identified": record["law"], "true_law": truth}
    starts = {"velocity": motion, "fitted": identified.best.motions[0]}
    for (law, spec), (start, initial) in product(laws.items(), starts.items()):
        state = initial.of_body(body)
        path, _ = predict(model, analytic_law(spec, model.dt), state, video.frames, tracers[0])
        row[f"rmse_mm_{law}_{start}_start"] = tracer_errors(path.tracers, tracers)["tracer_rmse_mm"]
    return row


def _combinations(identified: Identified, truth: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Combinations whose errors are independent, if the truth has all of the constants."""
    true = physical(constants_of(truth))
    if set(true) != set(physical(identified.best.values)):
        return []
    rows = []
    for entry in identified.best.combinations(identified.settings):
        error = entry["log_value"] - sum(
            power * math.log(true[key]) for key, power in entry["powers"].items()
        )
        rows.append({**entry, "log_error": error, "error_in_std": error / entry["log_std"]})
    return rows


def summary(rows: Sequence[Mapping[str, Any]]) -> str:
    """Coverage, closeness, choice of family, motion and time over scenes, as lines."""
    lines = []
    for kind in ("quantities", "material", "combinations"):
        entries = [e for row in rows for e in row[kind]]
        sure = [e for e in entries if e["determined"]]
        if sure:
            covered = sum(abs(e["error_in_std"]) < COVERED for e in sure)
            close = sum(abs(e["error_in_std"] * e["log_std"]) < math.log(1 + CLOSE) for e in sure)
            rms = math.sqrt(sum(e["error_in_std"] ** 2 for e in sure) / len(sure))
            lines.append(
                f"{kind}: {len(sure)} of {len(entries)} determined, truth within {COVERED:g} standard deviations in "
                f"{covered}, within {CLOSE:.0%} in {close}, rms z {rms:.2f}"
            )
    known = [row["family_is"] for row in rows if row["family_is"]]
    lines.append("family: " + ", ".join(f"{known.count(ok)} {ok}" for ok in ("right", "tie", "wrong")))
    for key in [key for key in rows[0] if key.startswith("rmse")]:
        lines.append(f"{key}: {sum(row[key] for row in rows) / len(rows):.2f} on average")
    seconds = [row["core_seconds"] for row in rows]
    lines.append(f"core seconds: {sum(seconds) / len(seconds):.0f} on average, at most {max(seconds):.0f}")
    return "\n".join(lines)


def lines_of(row: Mapping[str, Any]) -> str:
    """Readable lines of a scene."""
    record = row["found"]
    ties = f" (tie with {', '.join(record['ties'])})" if record["ties"] else ""
    lines = [
        f"{row['scene']}: {record['family']}{ties}, {row['family_is'] or 'truth is no candidate'}; "
        f"{record['rollouts']} rollouts, {row['core_seconds']:.0f} core s; "
        + ", ".join(f"{key[5:]} {value:.2f}" for key, value in row.items() if key.startswith("rmse"))
    ]
    for of, e in [("quantities", e) for e in row["quantities"]] + [("material", e) for e in row["material"]]:
        lines.append(
            f"    {of:10} {e['quantity']:16} {e['value']:10.4g} true {e['truth']:10.4g} ({e['error_percent']:+.0f}%) "
            f"log std {e['log_std']:.3f} z {e['error_in_std']:+.1f} {'determined' if e['determined'] else ''}"
        )
    return "\n".join(lines)


def main() -> None:
    parser = scene_parser(__doc__, nargs="*")
    parser.add_argument("--set", default="{}", help="changes of the settings of `identify`, as JSON")
    parser.add_argument("--jobs", type=int, default=1, help="scenes at a time")
    parser.add_argument("--out", type=Path, help="JSON file for all numbers")
    args = parser.parse_args()
    changes = json.loads(args.set)
    jobs = [
        (name, settings, changes)
        for name, settings in chosen_scenes(args).items()
        if (args.scenes or name.startswith(settings.random.prefix))
        and Path(settings.results_root, name, "velocity.json").exists()
    ]
    if not jobs:
        parser.error("no such scene has results: make velocity.json first")
    rows = []
    with multiprocessing.get_context("spawn").Pool(args.jobs, maxtasksperchild=1) as pool:
        for row in pool.imap_unordered(evaluate, jobs):
            rows.append(row)
            print(lines_of(row), flush=True)
            if args.out:
                write_json(args.out, {row["scene"]: row for row in rows})
    print(summary(rows))


if __name__ == "__main__":
    main()
