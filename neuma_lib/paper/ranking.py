"""The place of a result among the methods of a recorded table."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path

from neuma_lib.io.files import existing, reading

TABLES = ("table1", "table1_converged", "uneven_mass", "outside", "random")
"""Recorded tables, of which the first that has a scene is used."""
_SUFFIX = "_rmse_mm"


def recorded(table: str | Path, scene: str) -> dict[str, dict[str, float]]:
    """Quantity -> method -> value in a scene of a table of `neuma_lib.paper` (CSV). Empty without the scene."""
    with reading(existing(table), "a table"):
        rows = list(csv.DictReader(io.StringIO(Path(table).read_text(encoding="utf-8"))))
    values: dict[str, dict[str, float]] = {}
    with reading(table, "a table"):
        for row in rows:
            if row.get("scene") == scene:  # a row for each scene, a column for each method
                methods = {key.removesuffix(_SUFFIX): row[key] for key in row if key.endswith(_SUFFIX)}
                values["tracer_rmse_mm"] = {method: float(value) for method, value in methods.items()}
            elif row.get(scene) and "quantity" in row:
                values.setdefault(row["quantity"], {})[row["title"]] = float(row[scene])
    return values


def places(metrics: Mapping[str, float], values: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    """For each measured quantity of a table: place among the methods, and the next better and worse ones."""
    result = {}
    for quantity, methods in values.items():
        if quantity in metrics and len(methods) > 1:
            ranked = sorted(methods.items(), key=lambda entry: entry[1])
            better = [entry for entry in ranked if entry[1] < metrics[quantity]]
            worse = ranked[len(better) :]
            neighbours = [f"behind {name} {value:.3g}" for name, value in better[-1:]]
            neighbours += [f"ahead of {name} {value:.3g}" for name, value in worse[:1]]
            result[quantity] = f"place {len(better) + 1} of {len(ranked) + 1} ({', '.join(neighbours)})"
    return result


def find_table(folder: str | Path, scene: str) -> Path | None:
    """The recorded table with a scene in a folder of `TABLES`, or None."""
    files = (Path(folder, f"{name}.csv") for name in TABLES)
    return next((file for file in files if file.is_file() and recorded(file, scene)), None)
