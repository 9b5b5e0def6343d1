"""The table of the benchmarks (Table 4) as CSV and Markdown."""

from collections.abc import Mapping
from typing import Any

from neuma_lib.evaluation.text_tables import as_csv, as_markdown
from neuma_lib.paper.published import BENCHMARKS, BENCHMARKS_LABEL


def benchmark_table(scenes: Mapping[str, Mapping[str, Any]]) -> tuple[str, str]:
    """Properties of the benchmarks, with the materials that the paper does not publish.

    Args:
        scenes: scene -> its complete plain settings, with the number of simulated ``steps``.

    Returns:
        CSV, and Markdown with the paper's numbers in brackets where they differ from ours.
    """
    header = {
        "benchmark": "Benchmark",
        "shape": "Initial shape",
        "dynamics": "Dynamics",
        "dt": "Step size [s]",
        "velocity": "Initial velocity [m/s]",
        "height": "Initial height [m]",
        "steps": "Steps",
        "size": "Size [m]",
        "density": "Density [kg/m³]",
        "elasticity": "Elasticity",
        "plasticity": "Plasticity",
        "prior": "Prior",
    }
    table, cells, same, other = [], [], [], []
    for name, scene in scenes.items():
        printed = BENCHMARKS.get(name, {})
        row = {
            "benchmark": name,
            "dynamics": printed.get("dynamics", ""),
            **{key: _constant(value) for key, value in (scene | scene["law"]).items() if key in header},
        }
        table.append([row[key] for key in header])
        if printed:
            differing = [key for key in ("dt", "velocity", "height") if printed[key] != scene[key]]
            row |= {key: f"{row[key]} (*paper: {_constant(printed[key])}*)" for key in differing}
            (other if differing else same).append(name)
        cells.append([row[key] for key in header])
    remarks = []
    if same:
        remarks.append(
            f"Step size, velocity and height are the paper's ({BENCHMARKS_LABEL}) for {', '.join(same)}."
        )
    if other:
        remarks.append(f"They differ from it for {', '.join(other)}. The paper's numbers are in brackets.")
    text = [
        "# Table 4: the benchmarks",
        "",
        *as_markdown(list(header.values()), cells),
        "",
        " ".join(remarks),
    ]
    text += ["", "The paper does not publish materials, sizes and densities: those are ours.", ""]
    return as_csv([header, *table]), "\n".join(text)


def _constant(value: Any) -> str:
    """A setting as the text of a cell."""
    if isinstance(value, Mapping):
        name = str(value.get("name", "")).replace("_", " ")
        constants = ", ".join(f"{key} {_constant(v)}" for key, v in value.items() if key != "name")
        return f"{name}: {constants}" if name and constants else name or constants
    if isinstance(value, list | tuple):
        return f"({', '.join(map(_constant, value))})"
    return f"{value:g}" if isinstance(value, int | float) else str(value)
