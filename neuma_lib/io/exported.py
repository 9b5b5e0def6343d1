"""Metadata :data:`EXPORT` of the file of an exported law, and the check of its time step.

| key | content |
|---|---|
| ``schema`` | version of these keys, :data:`SCHEMA` |
| ``kind`` | "networks", "structured" or "analytic" |
| ``dt``, ``step``, ``any_step`` | time step of the training [s]; its effect on the law, "none", "follows" or "fixed" (`neuma_lib.mechanics.time_step`); true if other steps are allowed |
| ``grid``, ``gravity``, ``density`` | of the training: cells along the unit cube, [m/s^2], [kg/m^3] (or two on either side of a plane) |
| ``scale`` | metres of the simulator per metre of the filmed world; forces over mass scale with it, moduli over density with its square |
| ``units`` | of inputs and outputs |
| ``scene``, ``method``, ``prior``, ``weight`` | scene, method and prior of the training; weight w of the correction |
| ``commit`` | of the code that wrote the file |
| ``metrics`` | numbers of its metrics.json |
| ``constants`` | ``value`` and ``log_std``, the standard deviation of the logarithm, of the constants of an identified law |
| ``visited`` | ranges of the states visited in the training scene (`neuma_lib.evaluation.material_point`); the law is untrained outside them |

Unknown values are null.
"""  # noqa: E501

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuma_lib.errors import InputError
from neuma_lib.io.files import located, one_line
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
"""Relative difference up to which two time steps are equal."""


def about_law(law: Law, dt: float | None, any_time_step: bool = False, **known: Any) -> dict[str, Any]:
    """Metadata of a law; keys of the module that are neither given nor derived from the law are null.

    Raises:
        InputError: a number that is not finite, or a time step that is not positive.
    """
    check_step("dt", dt)
    for key, value in known.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise InputError(key, f"{value} must be a finite number")
    conditions = ("grid", "gravity", "density", "scale")
    origin = ("scene", "method", "prior", "commit", "metrics", "visited", "constants")
    kind = "networks" if isinstance(law, AdaptableLaw) else "analytic"
    return {
        **dict.fromkeys((*conditions, *origin)),
        "schema": SCHEMA,
        "kind": "structured" if isinstance(law, StructuredLaw) else kind,
        "dt": dt,
        "step": step_dependence(law),
        "any_step": any_time_step,
        "units": UNITS,
        "weight": 1.0,
        **known,
    }


def read_about(path: str | Path) -> dict[str, Any]:
    """Metadata of the file of an exported law. Raises InputError if it has none."""
    _, metadata = read_weights(path)
    if EXPORT not in metadata:
        raise InputError(path, "was not written by export-law and has no metadata of the law")
    try:
        return checked_export(metadata)
    except InputError as error:
        raise located(error, path) from None


def checked_export(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """The part :data:`EXPORT` of a file's metadata, with schema and time step checked."""
    about = metadata[EXPORT]
    schema = about.get("schema") if isinstance(about, dict) else None
    if type(schema) is not int or not 1 <= schema <= SCHEMA:
        problem = f"this code reads up to version {SCHEMA}, not {one_line(schema)}"
        raise InputError(f"{EXPORT}.schema", problem, "Update the code, or export the law again")
    check_step(f"{EXPORT}.dt", about.get("dt"))
    return about


def check_step(where: str, dt: Any) -> None:
    """Raise an `InputError` for a time step that is neither null nor a positive, finite number."""
    if dt is not None and not (type(dt) in (int, float) and 0 < dt < math.inf):
        raise InputError(where, f"{one_line(dt)} must be a positive number of seconds")


def fitting_step(about: Mapping[str, Any], dt: float | None, any_time_step: bool = False) -> float | None:
    """The time step of a law [s]: the given one, or that of its training.

    Raises:
        InputError: the law is fixed to the step of its training, ``dt`` differs, and neither the caller nor the file
            allows other steps.
    """
    check_step("dt", dt)
    own = about.get("dt")
    if dt is None or own is None:
        return own if dt is None else dt
    other = abs(dt - own) > SAME_STEP * own
    if other and about.get("step") == "fixed" and not (any_time_step or about.get("any_step") is True):
        raise InputError(
            "dt",
            f"the law was trained at a time step of {own:g} s and its plastic network is applied once a step, so at "
            f"{dt:g} s it is another material",
            f"Use dt: {own:g}, or allow other steps by any_time_step=True in Python or by "
            "`neuma law export ... --any-step`",
        )
    return dt
