"""Texts of all tables, compared byte by byte with files in ``golden/``.

After an intended change of a text, run ``python -m tests.paper.test_golden`` and inspect the difference.
"""

from pathlib import Path

import pytest

from neuma_lib.evaluation.stress import PARTS
from neuma_lib.paper.identified_table import identified_table
from neuma_lib.paper.published import BENCHMARKS, PAPER
from neuma_lib.paper.random_scenes import random_table
from neuma_lib.paper.reports import benchmark_table
from neuma_lib.paper.stress_table import stress_table
from neuma_lib.paper.tables import chamfer_table
from tests.support.random_results import METHODS, result
from tests.support.table_results import run

GOLDEN = Path(__file__).parent / "golden"
DIVERGED = {
    "diverged": {"happened": "moved by more than a cell in a step", "step": 80, "particle": 7},
    "energy_gain_after_step": 60,
}
HENCKY = {"elasticity": {"name": "hencky", "E": 1e5, "nu": 0.25}, "plasticity": {"name": "identity"}}
NEO_HOOKEAN = {"elasticity": {"name": "neo_hookean", "E": 1e5, "nu": 0.25}}


def errors_of(table: str, replicates: int, **extra) -> tuple[str, str]:
    """A table in which each method of its claims is twice as far off as the one before, with two divergent runs."""
    paper = PAPER[table]
    methods = list(dict.fromkeys(m for claim in paper.claims for m in sorted(claim.methods)))
    metrics = {
        method: {
            column: [run(2.0**k * (2 + c + 0.1 * r * (c + 1))) for r in range(replicates)]
            for c, column in enumerate(paper.columns)
        }
        for k, method in enumerate([*methods, "true_law"])
    }
    first, last = paper.columns[0], paper.columns[-1]
    metrics[methods[0]][last][-1] |= DIVERGED
    metrics[methods[1]][first][0] |= {"stable": False, "tracer_rmse_mm": 40.0}
    titles = {method: method.replace("_", " ") for method in metrics}
    columns = {column: column.replace("_", " ") for column in paper.columns}
    table = chamfer_table(metrics, titles, columns, paper, **extra)
    return table.csv(), table.markdown()


def stress() -> tuple[str, str]:
    paper = PAPER["stress"]
    columns = {column: column for column in paper.columns}
    titles = {"neuma_structured": "Structured", "neuma": "NeuMA"}

    def errors(value: float, broken: int = 0) -> dict:
        parts = dict.fromkeys(PARTS, value)
        parts |= {"path": None if broken else value}
        return parts | {"asymmetric": value / 10, "true_rms": 2e3, "broken_paths": broken}

    content = {
        method: {
            c: [errors(scale * (1 + k + r), broken=2 * (k + r == 7)) for r in range(3)]
            for k, c in enumerate(columns)
        }
        for method, scale in (("neuma_structured", 0.03), ("neuma", 0.1))
    }
    return stress_table(content, titles, columns, paper)[:2]


def identified() -> tuple[str, str]:
    def scene(name: str, family: str, ties: list[str], value: float, group: str) -> dict:
        quantities = {
            "E": {"value": value, "log_std": 0.05, "determined": True},
            "nu": {"value": 0.2, "log_std": 0.4, "determined": False},
        }
        laws = {"hencky": HENCKY, "neo_hookean": NEO_HOOKEAN}
        families = {name: {"law": law} for name, law in laws.items()}
        content = {"family": family, "law": laws[family], "ties": ties, "families": families}
        content |= {"best": {"quantities": quantities}}
        return {"name": name, "group": group, "identified": content, "truth": HENCKY, "converged": False}

    return identified_table([
        scene("Ball", "hencky", [], 1.02e5, "benchmarks"),
        scene("Duck", "neo_hookean", ["hencky"], 1.3e5, "benchmarks"),
        scene("R1", "neo_hookean", [], 9.9e4, "random scenes"),
    ])  # fmt: skip


def drawn() -> tuple[str, str]:
    scenes = [result(f"R{k}", 8.0, 2.0 + k) for k in range(3)]
    return random_table([*scenes, result("R3", 4.0, 5.0, failed=["neuma"], depth=0.3)], METHODS, 7)[:2]


def benchmarks() -> tuple[str, str]:
    known = {
        name: {key: row[key] for key in ("dt", "velocity", "height")} for name, row in BENCHMARKS.items()
    }
    known |= {"JellyDuck": known["JellyDuck"] | {"velocity": [0.5, -1, 0]}, "Own": known["ClayCat"]}
    common = {
        "shape": {"name": "ball", "radius": 0.1},
        "steps": 400,
        "size": 0.5,
        "density": 1000,
        "prior": "jelly",
    }
    return benchmark_table({name: common | values | {"law": HENCKY} for name, values in known.items()})


TABLES = {
    "table1": lambda: errors_of("table1", 3, notes={"neuma": "Mind this."}),
    "table3": lambda: errors_of("table3", 1),
    "outside": lambda: errors_of("outside", 3, note="See elsewhere."),
    "yardstick": lambda: errors_of("yardstick", 2),
    "stress": stress,
    "identified": identified,
    "random": drawn,
    "table4": benchmarks,
}


@pytest.mark.parametrize("name", TABLES)
def test_tables_equal_golden_files(name):
    csv, markdown = TABLES[name]()
    assert markdown == (GOLDEN / f"{name}.md").read_text()
    assert csv == (GOLDEN / f"{name}.csv").read_text()


if __name__ == "__main__":
    for name, build in TABLES.items():
        for suffix, text in zip((".csv", ".md"), build(), strict=True):
            (GOLDEN / f"{name}{suffix}").write_text(text)
