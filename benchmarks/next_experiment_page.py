"""Page of the study of chosen next experiments (`benchmarks.next_experiment`), from the results of its tasks."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from neuma_lib.evaluation.calibration import GRID, quantiles_of
from neuma_lib.evaluation.text_tables import as_markdown
from neuma_lib.project.settings import Config

EXPERIMENTS = 4  # of a loop, with the first one


@dataclass(frozen=True)
class Task:
    """Work on a material: "ranking", "fit" with the rank of a candidate, or "loop" with 1 if it chooses, else 0."""

    scene: str
    kind: str
    number: int


@dataclass
class Material:
    """What the tasks of a material give.

    Attributes:
        fits: joint fits with a finite result, in the order of the ranking.
        complete: whether all candidates have been fitted.
        alone: the fit to the first launch.
        rounds: of the loop with random launches, and of that with chosen experiments.
        inside: whether its family is a candidate.
        refused: why a task has no result.
    """

    name: str
    family: str
    inside: bool
    limit: float
    fits: list[dict[str, Any]]
    complete: bool
    alone: dict[str, Any]
    rounds: list[list[dict[str, Any]]]
    refused: str

    @classmethod
    def of(cls, name: str, settings: Config, results: Mapping[Task, dict[str, Any]]) -> "Material":
        own = {task: result for task, result in results.items() if task.scene == name}
        ranked = own.get(Task(name, "ranking", 0), {})
        done = [result for task, result in own.items() if task.kind == "fit"]
        complete = 0 < len(done) == len(ranked.get("options", ()))
        fits = sorted((each for each in done if "std" in each), key=lambda each: each["rank"])
        family, known = settings.random.family(name), settings.identify
        rounds = [own.get(Task(name, "loop", k), {}).get("rounds", []) for k in range(2)]
        refused = "; ".join(dict.fromkeys(each["refused"] for each in own.values() if "refused" in each))
        inside, alone = family in known.families, ranked.get("alone", {})
        return cls(name, family, inside, known.determined, fits, complete, alone, rounds, refused)

    def of_kinds(self, *kinds: str) -> list[dict[str, Any]]:
        return [fit for fit in self.fits if fit["kind"] in kinds]

    def over_random(self, measure: Callable[[dict[str, Any]], float], *kinds: str) -> list[float]:
        """Logarithm of a measure of the best-ranked experiment of some kinds, or of all, over random launches."""
        chosen = (self.of_kinds(*kinds) if kinds else self.fits)[:1]
        launches = self.of_kinds("launch")
        if chosen and launches:
            return [measure(chosen[0]) - float(np.mean([measure(fit) for fit in launches]))]
        return []

    def experiments(self, choose: bool) -> list[int]:
        """Number of experiments until all constants are determined, `EXPERIMENTS` + 1 if they are not."""
        rounds = self.rounds[choose]
        done = [k for k, each in enumerate(rounds, 1) if max(each["std"].values()) < self.limit]
        return [min(done, default=EXPERIMENTS + 1)] if rounds else []

    def distinguished(self) -> list[bool]:
        """Whether no other family predicts as well after two experiments, and the family is the true one."""
        after = [each for each in self.rounds[True][:2]][-1:]
        return [not each["ties"] and (each["family"] == self.family or not self.inside) for each in after]

    def row(self) -> list[Any]:
        parts = self.fits[:1]
        stds = [[log_std(self.alone)] if self.alone else [], [log_std(fit, "predicted") for fit in parts]]
        stds += [list(map(log_std, some)) for some in (parts, self.of_kinds("launch"))]
        stds += [[min(map(log_std, self.fits))] if self.complete else []]
        return [
            self.name,
            parts[0]["kind"] if parts else self.refused.partition(", and")[0],
            *(f"{100 * math.exp(np.mean(each)):.0f} %" if each else "" for each in stds),
            *("".join(map(str, self.experiments(choose))) for choose in (True, False)),
        ]


def log_std(fit: Mapping[str, Any], key: str = "std") -> float:
    """Logarithm of the geometric mean of the standard deviations."""
    return float(np.mean(np.log(list(fit[key].values()))))


def log_error(fit: Mapping[str, Any]) -> float:
    """Logarithm of the root mean square of the errors."""
    return 0.5 * math.log(np.mean(np.square(list(fit["error"].values()))))


SHARES = {0.5: "0.45 to 0.55", 0.8: "0.75 to 0.85", 0.95: "0.92 to 0.98"}  # goals of calibrated intervals
STDS = ("std: one launch", "predicted", "chosen", "random", "best")
HEADER = ("material", "chosen", *STDS, "experiments: chosen", "random")
PAGE = """\
# Chosen next experiments

    {command}

{measures}

{materials}

Standard deviations (std) are geometric means over the constants of those of their logarithms. Errors are root mean
squares of the logarithms of their ratios to the true ones. Ratios have 95 % confidence from a bootstrap over the
materials. The last columns are the numbers of experiments until all constants are determined, where {more} stands for
more than {limit}. The best in hindsight is that of all candidates, of
materials where all have been fitted. Intervals extend by calibrated multiples of the predicted standard deviations
([calibrated intervals](../calibration.md)).
"""


def page(materials: Sequence[Material], command: str) -> str:
    """Measures over all materials, and a row for each."""
    inside = [each for each in materials if each.inside]
    fits = [fit for each in materials for fit in each.fits]
    known = {
        "": [fit for each in inside for fit in each.fits],
        " of the chosen": [fit for each in inside for fit in each.fits[:1]],
    }
    z = {
        name: [abs(fit["error"][key]) / fit["predicted"][key] for fit in some for key in fit["error"]]
        for name, some in known.items()
    }
    calibration = [log_std(fit, "predicted") - log_std(fit) for fit in fits]
    chosen, random = ([n for each in materials for n in each.experiments(choose)] for choose in (True, False))
    distinct = [own for each in materials for own in each.distinguished()]

    def ratio(logs: Sequence[float]) -> list[str]:
        """Geometric mean with 95 % confidence from a bootstrap over the materials, and their number."""
        if not logs:
            return ["", "0"]
        drawn = np.random.default_rng(0).choice(logs, (4000, len(logs))).mean(1)
        low, high = np.exp(np.quantile(drawn, (0.025, 0.975)))
        return [f"{math.exp(np.mean(logs)):.2f} [{low:.2f}, {high:.2f}]", str(len(logs))]

    def against(
        measure: Callable[[dict[str, Any]], float], some: Sequence[Material], *kinds: str
    ) -> list[str]:
        return ratio([value for each in some for value in each.over_random(measure, *kinds)])

    def median(numbers: Sequence[int]) -> list[str]:
        return [f"{np.median(numbers):g}" if numbers else "", str(len(numbers))]

    best = [log_std(each.fits[0]) - min(map(log_std, each.fits)) for each in materials if each.complete]
    rows = [
        ["std, chosen experiment over random launches", "0.6", *against(log_std, materials)],
        ["std, chosen launch over random launches", "0.6", *against(log_std, materials, "launch", "turned")],
        ["std, chosen experiment over the best in hindsight", "1.1", *ratio(best)],
        ["errors, chosen experiment over random launches", "", *against(log_error, inside)],
        ["errors, chosen launch over random launches", "", *against(log_error, inside, "launch", "turned")],
        ["experiments, median of chosen ones", "half of random", *median(chosen)],
        ["experiments, median of random launches", "", *median(random)],
        *(
            [
                f"predicted over reported std, {name}",
                "1",
                f"{np.exp(np.quantile(calibration, q)):.2f}" if fits else "",
                f"{len(materials)}, {len(fits)} fits",
            ]
            for name, q in (("10th percentile", 0.1), ("median", 0.5), ("90th percentile", 0.9))
        ),
        *(
            [
                f"errors{name} in the predicted {100 * level:.0f} % interval",
                goal,
                f"{np.mean(np.less(own, quantiles_of(GRID).at(level))):.2f}" if own else "",
                f"{len(inside)}, {len(own)} constants",
            ]
            for name, own in z.items()
            for level, goal in SHARES.items()
        ),
        [
            "families distinguished after two experiments",
            "22 of 24",
            f"{sum(distinct)} of {len(distinct)}" if distinct else "",
            str(len(distinct)),
        ],
    ]
    measures = as_markdown(["measure", "goal", "result", "materials"], [row for row in rows if row[2]])
    table = as_markdown(HEADER, [each.row() for each in materials])
    return PAGE.format(
        command=command,
        measures="\n".join(measures),
        materials="\n".join(table),
        limit=EXPERIMENTS,
        more=EXPERIMENTS + 1,
    )
