"""Identification judged against known truths: constants with their uncertainty, choice of family, motion, time.

    python -m benchmarks.identification RubberPawn                          # reads data/, results/, config/config.yaml
    python -m benchmarks.identification random1_05 random2_03 --seeds 1 2 --count 12 --jobs 16 --out found.json
    python -m benchmarks.identification random1_05 --set '{"prune_factor": 3}'   # other settings of `identify`
    python -m benchmarks.identification random1_02 --seeds 1 --count 8 --simplex   # only: two ways to find constants

A scene may be named by the beginning of its name; without names, all random scenes that have results are taken.
Dataset and reconstruction must exist (`snakemake results/SCENE/velocity.json`). The truth is read here and nowhere in
the library. Settings are to be tuned on draws that are not reported.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import resource
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize

from benchmarks.project_scenes import chosen_scenes, scene_parser, simulator
from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.scenes import SceneConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError
from neuma_lib.evaluation.metrics import tracer_errors
from neuma_lib.fitting.families import Family
from neuma_lib.fitting.identified import Identified
from neuma_lib.fitting.identify import _LAST_GAIN, _Run, identify
from neuma_lib.fitting.thrown_video import NUISANCES, Candidate, VideoResiduals, averaged
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.files import read_json, write_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import load_observation
from neuma_lib.io.mesh import read_mesh
from neuma_lib.io.particles import load_body
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.combinations import named_combinations, physical
from neuma_lib.project.loading import merged
from neuma_lib.project.settings import Config
from neuma_lib.sim.prediction import predict
from neuma_lib.splatting.observation import Observation

TRACERS = 2000  # of the truth's, for the motion
COVERED = 2.0  # standard deviations
CLOSE = 0.1  # relative error
SIMPLEX_EDGE = 0.5  # of the first round's simplex in unbounded constants, halved from round to round
SIMPLEX_ROLLOUTS = 4  # most rollouts of the simplex, in those of Levenberg-Marquardt
AS_GOOD = 0.01  # relative difference of squared residuals


def judge(name: str, settings: Config, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Identify one scene and compare with its truth; plain numbers."""
    torch.set_num_threads(1)
    scene, chosen, throw, body, video = _read(name, settings, changes)
    data, results = Path(settings.data_root) / name, Path(settings.results_root) / name
    mesh = read_mesh(results / "mesh.ply")
    finer = [
        body.resampled(
            torch.from_numpy(sample_volume(mesh, chosen.refined_particles, seed)),
            mesh.volume,
            scene.density,
            settings.binding,
        )
        for seed in range(1, 1 + (chosen.resamplings if chosen.refined_particles else 0))
    ]
    model = simulator(settings, scene)
    stock = settings.priors.laws.get(scene.prior)
    before = _core_seconds()
    found = identify(model, throw, body, video, chosen, stock.plain() if stock else None, refined=[finer])
    seconds = _core_seconds() - before
    truth = scene.law.plain()
    row = {
        "scene": name,
        "truth": truth,
        "core_seconds": seconds,
        **_family(found, truth),
        "quantities": _quantities(found, truth),
        "combinations": _combinations(found, truth),
        "found": found.as_dict(),
    }
    arrays, _ = read_arrays(data / "truth.h5", required=("tracers",), only=("tracers",))
    tracers = torch.from_numpy(arrays["tracers"])
    tracers = tracers[:, :: max(1, tracers.shape[1] // TRACERS)].to(body.x0)
    laws = {"identified": row["found"]["law"], "true_law": truth}
    starts = {"velocity": throw, "fitted": found.best.motions[0]}
    for law, spec in laws.items():
        for start, thrown in starts.items():
            path, _ = predict(
                model, analytic_law(spec, model.dt), thrown.of_body(body), video.frames, tracers[0]
            )
            row[f"rmse_mm_{law}_{start}_start"] = tracer_errors(path.tracers, tracers)["tracer_rmse_mm"]
    return row


def compare(name: str, settings: Config, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Fit the true family's constants by Levenberg-Marquardt and by Nelder and Mead's simplex; plain numbers.

    Both begin at the family's guess, go through the same squares with the same tolerance of the squared residuals, and
    hold the throw; the former alone is weakly held at the guess (`identify.spread`). Images that the simplex has seen
    serve all sizes of squares, too. "After as many rollouts" is the best of all points that it has tried.
    """
    torch.set_num_threads(1)
    scene, chosen, throw, body, video = _read(name, settings, changes)
    truth = scene.law.plain()
    constants = _constants(truth)
    families = [Family(key, law.plain()) for key, law in chosen.families.items()]
    alike = (f for f in families if (_kind(f.spec), set(f.constants)) == (_kind(truth), set(constants)))
    family = next(alike, None)
    if family is None:
        raise InputError(
            f"identify.families has no family of the law of {name}: take another scene for --simplex"
        )
    model = simulator(settings, scene)
    thrown = VideoResiduals(model, throw, body, video, chosen)
    thrown.hold_out(family, chosen.held_out)
    rounds = range(len(chosen.pyramid))
    origin, known = family.unbounded(family.guess), np.zeros(NUISANCES)
    images: dict[bytes, torch.Tensor | None] = {}
    finest: list[float] = []  # squared residuals at the finest squares, of one rollout after the other

    def values(u: np.ndarray) -> dict[str, float]:
        return family.values(origin + u, model, thrown.density)

    def log_cost(u: np.ndarray, level: int) -> float:
        """A simplex only compares; in logarithms its tolerance is relative."""
        key = u.tobytes()
        if key not in images:
            (images[key],) = thrown.residuals([Candidate(family.law_spec(values(u)), known)], thrown.fitted)
            finest.append(math.exp(log_cost(u, rounds[-1])))
        if images[key] is None:
            return math.inf
        return math.log(averaged(images[key], thrown.sizes[level]).square().sum(dtype=torch.float64))

    thrown.residuals([Candidate(family.law_spec(family.guess), known)], thrown.fitted)  # compiles
    begun = _core_seconds()
    run = _Run(family, [thrown], [thrown.fitted], chosen)
    run.begin([family.guess])
    for level in rounds[1:]:
        run.refine(level)
    least = run.fit.cost
    ways = {"Levenberg-Marquardt": _way(run.rollouts, begun, run.loss, run.values)}
    most, begun, u = SIMPLEX_ROLLOUTS * run.rollouts, _core_seconds(), np.zeros(len(origin))
    for level in rounds:
        first = u + np.vstack([np.zeros(len(u)), 0.5**level * SIMPLEX_EDGE * np.eye(len(u))])
        tolerance = chosen.min_gain * (_LAST_GAIN if level == rounds[-1] else 1.0)
        options = dict(initial_simplex=first, xatol=math.inf, fatol=tolerance, maxfev=most - len(finest))
        u = minimize(log_cost, u, (level,), "Nelder-Mead", options=options).x if most > len(finest) else u
    pixels = thrown.fitted_pixels
    loss = math.exp(log_cost(u, rounds[-1])) / pixels
    ways["simplex"] = _way(len(finest), begun, loss, values(u))
    as_good = (n for n, cost in enumerate(finest, 1) if cost <= (1 + AS_GOOD) * least)
    return {
        "scene": name,
        "family": family.name,
        "truth": constants,
        "ways": ways,
        "simplex_losses": [cost / pixels for cost in finest],
        "simplex_after_as_many": min(finest[: run.rollouts]) / pixels,
        "simplex_as_good_after": next(as_good, None),
    }


def _way(rollouts: int, begun: float, loss: float, values: Mapping[str, float]) -> dict[str, Any]:
    seconds = _core_seconds() - begun
    return {"rollouts": rollouts, "core_seconds": seconds, "loss": loss, "constants": dict(values)}


def comparison(row: Mapping[str, Any]) -> str:
    """Two ways to find the constants of a scene, for people."""
    lines = [f"{row['scene']}: {row['family']}, truth " + _listed(row["truth"])]
    for name, way in row["ways"].items():
        lines.append(
            f"    {name:20} {way['rollouts']:4} rollouts {way['core_seconds']:6.1f} core s, mean squared residual "
            f"{way['loss']:.4e}, " + _listed(way["constants"])
        )
    as_good = row["simplex_as_good_after"]
    lines.append(
        f"    the simplex's least residual after as many rollouts {row['simplex_after_as_many']:.4e}; within "
        f"{AS_GOOD:.0%} of the other " + (f"after {as_good}" if as_good else "never")
    )
    return "\n".join(lines)


def _listed(constants: Mapping[str, float]) -> str:
    return ", ".join(f"{key} {value:.4g}" for key, value in constants.items())


def _read(
    name: str, settings: Config, changes: Mapping[str, Any]
) -> tuple[SceneConfig, IdentifyConfig, InitialMotion, Reconstruction, Observation]:
    scene = settings.scene(name)
    data, results = Path(settings.data_root) / name, Path(settings.results_root) / name
    chosen = IdentifyConfig(**merged(settings.identify.plain(), changes))
    files = (results / name for name in ("particles.h5", "binding.h5", "gaussians.ply"))
    body = load_body(*files, scene.density, gaussian_motion=chosen.gaussian_motion).to(torch.float32)
    video = load_observation(data / "dynamic/transforms.json", chosen.views).to(torch.float32)
    return scene, chosen, InitialMotion.of(read_json(results / "velocity.json")), body, video


def _core_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _kind(spec: Mapping[str, Any]) -> tuple[str, str]:
    return spec["elasticity"]["name"], (spec.get("plasticity") or {"name": "identity"})["name"]


def _family(found: Identified, truth: Mapping[str, Any]) -> dict[str, Any]:
    """Whether the family is right, or tied with the right one; None where the truth is no candidate."""
    kinds = {name: _kind(fit.family.spec) for name, fit in found.fits.items()}
    right = [name for name, kind in kinds.items() if kind == _kind(truth) and "bingham" not in name]
    ok = None
    if right:
        ok = (
            "right" if found.best.family.name in right else "tie" if set(right) & set(found.ties) else "wrong"
        )
    return {"family": found.best.family.name, "ties": found.ties, "family_is": ok}


def _constants(spec: Mapping[str, Any]) -> dict[str, float]:
    return {key: float(value) for part in spec.values() for key, value in part.items() if key != "name"}


def _quantities(found: Identified, truth: Mapping[str, Any]) -> dict[str, Any]:
    """Named combinations that the truth has too: value, truth, standard deviation of the logarithm, z score."""
    true = named_combinations(_constants(truth))
    return {
        key: {
            "value": value,
            "truth": true[key],
            "log_std": std,
            "z": math.log(value / true[key]) / std,
            "determined": std < found.settings.determined,
        }
        for key, value, std in found.best.quantities(found.settings)
        if key in true
    }


def _combinations(found: Identified, truth: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The same of combinations whose errors are independent, if the truth has all of the constants."""
    true = physical(_constants(truth))
    if set(true) != set(physical(found.best.values)):
        return []
    rows = []
    for entry in found.best.combinations(found.settings):
        error = entry["log_value"] - sum(
            power * math.log(true[key]) for key, power in entry["powers"].items()
        )
        rows.append({**entry, "log_error": error, "z": error / entry["log_std"]})
    return rows


def summary(rows: Sequence[Mapping[str, Any]]) -> str:
    """Coverage, closeness, choice of family, motion and time over scenes, as lines."""
    lines = []
    for kind in ("quantities", "combinations"):
        entries = [e for row in rows for e in (row[kind].values() if kind == "quantities" else row[kind])]
        sure = [e for e in entries if e["determined"]]
        if sure:
            covered = sum(abs(e["z"]) < COVERED for e in sure)
            close = sum(abs(e["z"] * e["log_std"]) < math.log(1 + CLOSE) for e in sure)
            rms = math.sqrt(sum(e["z"] ** 2 for e in sure) / len(sure))
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
    """A scene for people."""
    ties = f" (tie with {', '.join(row['ties'])})" if row["ties"] else ""
    lines = [
        f"{row['scene']}: {row['family']}{ties}, {row['family_is'] or 'truth is no candidate'}; "
        f"{row['found']['rollouts']} rollouts, {row['core_seconds']:.0f} core s; "
        + ", ".join(f"{key[5:]} {value:.2f}" for key, value in row.items() if key.startswith("rmse"))
    ]
    for key, e in row["quantities"].items():
        lines.append(
            f"    {key:16} {e['value']:10.4g} true {e['truth']:10.4g} ({e['value'] / e['truth'] - 1:+.0%}) "
            f"log std {e['log_std']:.3f} z {e['z']:+.1f} {'determined' if e['determined'] else ''}"
        )
    return "\n".join(lines)


def main() -> None:
    parser = scene_parser(__doc__, nargs="*")
    parser.add_argument("--set", default="{}", help="changes of the settings of `identify`, as JSON")
    parser.add_argument("--jobs", type=int, default=1, help="scenes at a time")
    parser.add_argument("--simplex", action="store_true", help="only compare two ways to find constants")
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
    rows, one, told = [], *((compare, comparison) if args.simplex else (judge, lines_of))
    with multiprocessing.get_context("spawn").Pool(args.jobs, maxtasksperchild=1) as pool:
        for row in pool.imap_unordered(_called, [(one, job) for job in jobs]):
            rows.append(row)
            print(told(row), flush=True)
            if args.out:
                write_json(args.out, {row["scene"]: row for row in rows})
    if not args.simplex:
        print(summary(rows))


def _called(job: tuple[Callable[..., dict[str, Any]], tuple[Any, ...]]) -> dict[str, Any]:
    function, arguments = job
    return function(*arguments)


if __name__ == "__main__":
    main()
