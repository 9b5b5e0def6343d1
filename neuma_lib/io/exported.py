"""What a law that is passed on says of itself: the metadata :data:`EXPORT` of its file, and whether a time step suits it.

| key | content |
|---|---|
| ``schema`` | version of these keys, :data:`SCHEMA` |
| ``kind`` | "networks", "structured" or "analytic" |
| ``dt``, ``step``, ``any_step`` | time step that it was learned at [s]; "none", "follows" or "fixed", what the law has to do with it (`neuma_lib.mechanics.time_step`); true where use at other steps was asked for |
| ``grid``, ``gravity``, ``density`` | cells along the unit cube, [m/s^2], [kg/m^3] (or two on either side of a plane), of its learning |
| ``scale`` | metres of the simulator to a metre of the world that was filmed; forces over mass are as much larger, moduli over density by its square |
| ``units`` | of all that goes in and comes out |
| ``scene``, ``method``, ``prior``, ``weight`` | what it was learned on and from; weight w of its correction |
| ``commit`` | of the code that wrote the file |
| ``metrics`` | numbers of its metrics.json |
| ``visited`` | ranges of the states that the law went through in its scene (`neuma_lib.evaluation.material_point`): beyond them nothing was learned |

What is not known is null.
"""  # noqa: E501

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuma_lib.errors import InputError
from neuma_lib.io.files import one_line
from neuma_lib.io.weights import read_weights
from neuma_lib.mechanics.adaptor import AdaptableLaw
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.structured import StructuredLaw
from neuma_lib.mechanics.time_step import step_dependence

EXPORT = "export"
SCHEMA = 1
UNITS = {
    "length": "m",
    "time": "s",
    "mass": "kg",
    "elasticity": "deformation gradient F (1) -> Kirchhoff stress tau = P F^T (Pa)",
    "plasticity": "trial deformation gradient (1) -> elastic deformation gradient (1), once a time step",
}
SAME_STEP = 1e-6
"""Relative difference of time steps that count as one."""


def about_law(law: Law, dt: float | None, any_step: bool = False, **known: Any) -> dict[str, Any]:
    """What a file says of a law; keys of the module that are neither given nor told by the law are null."""
    unknown = (
        "grid",
        "gravity",
        "density",
        "scale",
        "scene",
        "method",
        "prior",
        "commit",
        "metrics",
        "visited",
    )
    kind = "networks" if isinstance(law, AdaptableLaw) else "analytic"
    return {
        **dict.fromkeys(unknown),
        "schema": SCHEMA,
        "kind": "structured" if isinstance(law, StructuredLaw) else kind,
        "dt": dt,
        "step": step_dependence(law),
        "any_step": any_step,
        "units": UNITS,
        "weight": 1.0,
        **known,
    }


def read_about(path: str | Path) -> dict[str, Any]:
    """What the file of a law says of it. Raises InputError where it says nothing."""
    _, metadata = read_weights(path)
    if EXPORT not in metadata:
        raise InputError(f"{path} was not written by export-law: it says nothing of the law in it")
    try:
        return checked_export(metadata)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def checked_export(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """The part :data:`EXPORT` of a file's metadata, if this code knows its schema and its step makes sense."""
    about = metadata[EXPORT]
    schema = about.get("schema") if isinstance(about, dict) else None
    if type(schema) is not int or not 1 <= schema <= SCHEMA:
        raise InputError(
            f"its metadata {EXPORT} have the schema {one_line(schema)}, and this code reads up to {SCHEMA}: update it, "
            "or export the law again"
        )
    dt = about.get("dt")
    if dt is not None and not (type(dt) in (int, float) and math.isfinite(dt) and dt > 0):
        raise InputError(f"its time step dt must be a positive number of seconds, not {one_line(dt)}")
    return about


def fitting_step(about: Mapping[str, Any], dt: float | None, any_step: bool = False) -> float | None:
    """The time step to use a law at [s]: the one that is asked for, or that of its learning.

    Raises:
        InputError: another step than that of its learning, for a law that is fixed to it, unless the caller or the file
            says that this is wanted.
    """
    own = about.get("dt")
    if dt is None or own is None:
        return own if dt is None else dt
    other = abs(dt - own) > SAME_STEP * own
    if other and about.get("step") == "fixed" and not (any_step or about.get("any_step") is True):
        raise InputError(
            f"it was learned at a time step of {own:g} s, and its plastic part, a network, returns once a step: at "
            f"{dt:g} s it is another material. Use dt: {own:g}, or, if you want it nevertheless, any_step=True in "
            "Python or a copy made with `neuma law export ... --any-step`"
        )
    return dt
