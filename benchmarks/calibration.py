"""Measure the quantiles of errors and the temperature of probabilities on finished scenes of development seeds.

    python -m benchmarks.calibration results/random2_*/calibration.json            # prints
    python -m benchmarks.calibration results/random2_*/calibration.json --write    # and stores them

The files are made by `snakemake --configfile config/studies/calibration.yaml -- calibration`. Prints the coverage of
intervals by cross-validation over the scenes, and the Brier score: what to expect on other scenes of the same kind.
`--write` replaces neuma_lib/evaluation/calibration.json, which all intervals use. Scenes of other seeds are refused,
because a calibration must not see what is reported.
"""

import math
import subprocess
from collections.abc import Mapping, Sequence, Set
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.timing import parser_of
from neuma_lib.errors import InputError
from neuma_lib.evaluation.calibration import FILE, LEVELS, QUANTITIES, Quantiles, family_probabilities
from neuma_lib.evaluation.coverage import brier_score, mean_over_scenes
from neuma_lib.io.files import read_json, write_json
from neuma_lib.paper.calibration_table import TARGETS, errors_in_std

FOLDS = 5
TEMPERATURES = tuple(np.geomspace(0.01, 30, 81))  # candidates of `fitted_temperature`


def measured_quantiles(z: Sequence[float]) -> Quantiles:
    """Quantiles of errors in estimated standard deviations, of which new ones are below with at least the probability.

    At a level p it is the ceil(p (n + 1))-th smallest of n values, or the largest if there are too few (Lei et al.
    2018, Theorem 2.1).
    """
    sizes, n = np.sort(np.abs(np.asarray(z, dtype=float))), len(z)
    if n == 0:
        raise InputError("errors", "there are none to measure quantiles of", "Give more scenes")
    ranks = [min(n, math.ceil(round(level * (n + 1), 9))) for level in LEVELS]
    return Quantiles(tuple(float(sizes[rank - 1]) for rank in ranks))


def fitted_temperature(scenes: Sequence[tuple[Mapping, Set[str]]]) -> float:
    """The temperature with the lowest mean Brier score.

    Args:
        scenes: content of identified.json, or its entries ``families`` and ``compared``, and the names of the true
            family.
    """
    means = [
        np.mean([brier_score(family_probabilities(known, each), right) for known, right in scenes])
        for each in TEMPERATURES
    ]
    return float(TEMPERATURES[int(np.argmin(means))])


def errors_by_quantity(scenes: Sequence[Mapping[str, Any]]) -> dict[str, list[np.ndarray]]:
    """Errors in estimated standard deviations of each scene that has some, by calibrated quantity."""
    by_scene = [errors_in_std(scene) for scene in scenes]
    pooled = {name: [own[name] for own in by_scene if len(own.get(name, ()))] for name in QUANTITIES}
    return {name: errors for name, errors in pooled.items() if errors}


def calibrated(scenes: Sequence[Mapping[str, Any]], source: Mapping[str, Any]) -> dict[str, Any]:
    """Content of the stored file.

    Raises:
        InputError: a scene is not of a development seed.
    """
    for scene in scenes:
        if not scene["development"]:
            raise InputError(scene["name"], "is not of a development seed", "Give scenes of one")
    errors = errors_by_quantity(scenes)
    families = _families(scenes)
    return {
        "levels": list(LEVELS),
        "quantiles": {
            name: [float(f"{q:.4g}") for q in measured_quantiles(np.concatenate(own)).values]
            for name, own in errors.items()
        },
        "counts": {name: {"scenes": len(own), "values": sum(map(len, own))} for name, own in errors.items()},
        **({"temperature": float(f"{fitted_temperature(families):.3g}")} if families else {}),
        "source": {
            "seeds": sorted({scene["seed"] for scene in scenes}),
            "scenes": sorted(scene["name"] for scene in scenes),
            **source,
        },
    }


def _families(scenes: Sequence[Mapping[str, Any]]) -> list[tuple[Mapping[str, Any], set[str]]]:
    """Scores and names of the true family, of scenes whose truth is a candidate."""
    return [(scene["families"], {*scene["families"]["right"]}) for scene in scenes if scene["families"]]


def cross_validated(errors: Sequence[np.ndarray], seed: int = 0) -> dict[float, tuple[float, float, float]]:
    """Coverage with its confidence at the levels of `TARGETS`, with quantiles from the scenes of the other folds."""
    order = np.random.default_rng(seed).permutation(len(errors))
    folds = [order[k::FOLDS] for k in range(min(FOLDS, len(errors)))]
    inside: dict[float, list[np.ndarray]] = {level: [] for level in TARGETS}
    for fold in folds:
        rest = [errors[i] for i in range(len(errors)) if i not in fold]
        if not rest:
            continue
        quantiles = measured_quantiles(np.concatenate(rest))
        for level, covered in inside.items():
            covered += [np.abs(errors[i]) <= quantiles.at(level) for i in fold]
    return {level: mean_over_scenes(covered) for level, covered in inside.items() if covered}


def report(scenes: Sequence[Mapping[str, Any]], content: Mapping[str, Any]) -> str:
    """Quantiles, coverage on other scenes and the Brier score as lines."""
    lines = []
    for name, errors in errors_by_quantity(scenes).items():
        count = content["counts"][name]
        lines.append(f"{name}: {count['values']} values of {count['scenes']} scenes")
        for level, (share, low, high) in cross_validated(errors).items():
            quantile = np.interp(level, LEVELS, content["quantiles"][name])
            lines.append(
                f"    {level:.0%}: quantile {quantile:.3g}, covers {share:.0%} [{low:.0%}, {high:.0%}] of other scenes"
            )
    if "temperature" in content:
        known = _families(scenes)
        scores = [
            np.array(brier_score(family_probabilities(one, content["temperature"]), right))
            for one, right in known
        ]
        share, low, high = mean_over_scenes(scores)
        lines.append(
            f"families: temperature {content['temperature']:.3g}, Brier score {share:.3f} [{low:.3f}, {high:.3f}] "
            f"on the same {len(known)} scenes"
        )
    return "\n".join(lines)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("records", nargs="+", type=Path, help="files calibration.json of scenes")
    parser.add_argument("--write", action="store_true", help="store the result in the library")
    args = parser.parse_args()
    scenes = list(map(read_json, args.records))
    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False
    ).stdout.strip()
    source = {
        "commit": commit,
        "date": datetime.now(UTC).date().isoformat(),
        "command": f"python -m benchmarks.calibration {' '.join(map(str, args.records[:1]))} ... --write",
    }
    try:
        content = calibrated(scenes, source)
    except InputError as error:
        parser.error(str(error))
    print(report(scenes, content))
    if args.write:
        write_json(FILE, content)
        print(f"written: {FILE}")


if __name__ == "__main__":
    main()
