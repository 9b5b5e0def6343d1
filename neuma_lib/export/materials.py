"""Our analytic laws as materials of other engines, and their materials as our laws. Needs no engine.

| ours | Genesis ``gs.materials.`` | newton ``SolverImplicitMPM``, ``mpm:`` | MuJoCo ``<elasticity>`` |
|---|---|---|---|
| neo_hookean | MPM.Elastic, "neohooken" | | |
| fixed_corotated | MPM.Elastic, "corotation" | | |
| hencky | | without yield | |
| stvk | | | ``young``, ``poisson`` |
| von_mises | MPM.ElastoPlastic of fixed_corotated | of hencky | |
| drucker_prager | MPM.Sand of hencky, without cohesion | of hencky | |
| cohesive_drucker_prager | | of hencky, without dilation | |
| fluid | MPM.Liquid | as hencky without shear | |
| viscous_flow | MPM.Liquid of hencky, without yield stress | of hencky | |

Sources: classes of genesis-world 1.4.5, kernels of newton 1.8.0 (``rheology_solver_kernels.py``), and the documentation
of MuJoCo 4.0.0. newton limits |dev tau| to sqrt(2) (yield_stress + friction p): its stress is a vector whose squared
norm is half that of the tensor. All engines sum stresses over the volume of undeformed particles or elements.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from neuma_lib.errors import InputError
from neuma_lib.mechanics.catalogue import ELASTICITY, PLASTICITY, check_constants, complete, lame

ENGINES = ("genesis", "newton", "mujoco")
UNBOUNDED = 1e12
"""Yield stress of a newton material that never yields, and pressure at which it is crushed [Pa]."""
_SAME_MODULI = 1e-6
"""Relative difference up to which moduli of both parts of a law are equal."""

Values = dict[str, float]
Arguments = dict[str, float | str | bool]


class EngineMaterial(NamedTuple):
    """A material of another engine.

    Attributes:
        kind: its class: ``MPM.<name>`` of ``genesis.materials``, ``mpm`` for the particle attributes of newton, or
            ``elasticity`` for the element of a MuJoCo flex.
        arguments: its arguments by name, in SI units.
        notes: what holds for it. The first states whether the formula is the same or converted.
    """

    kind: str
    arguments: Arguments
    notes: tuple[str, ...]


class _Refused(ValueError):
    """The engine has the family, but not with these constants."""


def engine_material(
    spec: Mapping[str, Any], density: float | None, substep: float | None, engine: str
) -> EngineMaterial:
    """An analytic law as the material of an engine.

    Args:
        spec: as of `Law.from_spec`.
        density: [kg/m^3].
        substep: time step of the engine [s]. Viscous flow of Genesis holds for this step only.
        engine: one of `ENGINES`.

    Raises:
        InputError: unknown engine or law, no density or step, or the engine has no such material. No part of a law is
            left out.

    Example:
        >>> engine_material({"elasticity": {"name": "neo_hookean", "E": 3e4, "nu": 0.4}}, 1000, 5e-4, "genesis").kind
        'MPM.Elastic'
    """
    check_engine(engine)
    density, substep = _positive("density", density, "kg/m^3"), _positive("substep", substep, "s")
    parts = complete(spec, substep)
    if viscosity := parts.pop("viscosity", None):
        problem = f"{engine} has no such material: its solids have no {viscosity['name']}"
        raise InputError("viscosity", problem, "Export the law without its viscous part")
    names = (parts["elasticity"]["name"], parts["plasticity"]["name"])
    elastic, plastic = (
        check_constants(part, known[values["name"]], {k: v for k, v in values.items() if k != "name"})
        for (part, values), known in zip(parts.items(), (ELASTICITY, PLASTICITY), strict=True)
    )
    for key in ("E", "nu"):
        if abs(plastic.get(key, elastic[key]) - elastic[key]) > _SAME_MODULI * abs(elastic[key]):
            raise InputError(
                f"plasticity.{key}",
                f"{plastic[key]:g} must equal elasticity.{key} = {elastic[key]:g} in {engine}",
            )
    try:
        return _convert(engine, names, {**elastic, **plastic}, density, substep)
    except _Refused as refusal:
        others = [other for other in ENGINES if _can(other, names, {**elastic, **plastic}, density, substep)]
        remedy = f"{' and '.join(others)} can" if others else "No engine can"
        problem = f"{engine} has no such material: {refusal}"
        raise InputError(
            f"law {' + '.join(names)}", problem, f"{remedy}. --fit fits the nearest one"
        ) from None


def check_engine(engine: str, known: tuple[str, ...] = ENGINES) -> None:
    """Raise an `InputError` for an engine that is not known."""
    if engine not in known:
        raise InputError("engine", f"{engine!r} must be one of {', '.join(known)}")


def _positive(name: str, value: Any, unit: str) -> float:
    if value is None:
        raise InputError(name, "is missing", f"Give it [{unit}] with --{name}")
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf:
        raise InputError(name, f"{value!r} must be one positive number [{unit}]")
    return float(value)


def _can(engine: str, names: tuple[str, str], values: Values, density: float, substep: float) -> bool:
    try:
        return bool(_convert(engine, names, values, density, substep))
    except _Refused:
        return False


def _convert(
    engine: str, names: tuple[str, str], values: Values, density: float, substep: float
) -> EngineMaterial:
    rule = RULES[engine].get(names)
    if rule is None:
        raise _Refused(f"it has {', '.join(' + '.join(each) for each in RULES[engine])}")
    kind, arguments, *notes = rule(values, substep)
    if engine == "genesis":
        arguments = {"E": values["E"], "nu": values["nu"], "rho": density, **arguments}
    return EngineMaterial(kind, arguments, tuple(notes))


# ---- rules: constants of a law and the time step [s] -> class, arguments, notes -------------------------------------

Rule = Callable[[Values, float], tuple[Any, ...]]
SAME = "same formula"


def _bulk(c: Values) -> float:
    """Bulk modulus [Pa]."""
    mu, lam = lame(c["E"], c["nu"])
    return lam + 2 * mu / 3


def _genesis_von_mises(c: Values, substep: float):
    if c["yield_stress"] == 0:
        raise _Refused("its yield_stress must be greater than 0 Pa")
    return (
        "MPM.ElastoPlastic",
        {"use_von_mises": True, "von_mises_yield_stress": c["yield_stress"]},
        SAME,
        "Genesis limits singular values to at least 0.05",
    )


def _genesis_sand(c: Values, substep: float):
    if c["cohesion"] > 0:
        raise _Refused("MPM.Sand has no cohesion")
    return (
        "MPM.Sand",
        {"friction_angle": c["friction_angle"]},
        "converted: same cone and stress. After an expansion Genesis compacts by the same volume before it resists",
    )


def _genesis_viscous(c: Values, substep: float):
    if c["yield_stress"] > 0:
        raise _Refused("MPM.Liquid has no yield stress")
    mu = c["viscosity"] / substep
    return (
        "MPM.Liquid",
        {"viscous": True, "mu": mu, "lam": _bulk(c) - 2 * mu / 3},
        f"converted: mu = viscosity / substep and lam = K - 2 mu / 3 hold at a substep of {substep:g} s only",
        f"without the elastic shear of our law, which relaxes in {c['viscosity'] / lame(c['E'], c['nu'])[0]:.2g} s",
    )


def _newton(c: Values, same: str, **others: float):
    """A newton material. Attributes that are not given do not limit the stress."""
    arguments = {
        "young_modulus": c["E"],
        "poisson_ratio": c["nu"],
        "damping": 0.0,
        "friction": 0.0,
        "yield_pressure": UNBOUNDED,
        "tensile_yield_ratio": 1.0,
        "yield_stress": UNBOUNDED,
        "viscosity": 0.0,
        "hardening": 0.0,
        "dilatancy": 0.0,
        **others,
    }
    step = (
        "newton's implicit step damps in proportion to the step. Halve it until the motion no longer changes"
    )
    return "mpm", arguments, same, step


def _newton_cone(c: Values, strength: float, same: str):
    """A Drucker-Prager cone with a tensile strength [Pa] at its apex."""
    sine = math.sin(math.radians(c["friction_angle"]))
    return _newton(
        c,
        same,
        friction=2 * math.sqrt(3) * sine / (3 - sine),
        yield_stress=0.0,
        tensile_yield_ratio=strength / UNBOUNDED,
    )


def _newton_cohesive(c: Values, substep: float):
    if c["dilation_angle"] > 0:
        raise _Refused("the dilatancy of newton is not the dilation angle")
    strength = c["cohesion"] / math.tan(math.radians(c["friction_angle"]))
    return _newton_cone(
        c, strength, "converted: the same cone with the tensile strength cohesion / tan friction_angle"
    )


def _newton_fluid(c: Values, substep: float):
    _, lam = lame(c["E"], c["nu"])
    if lam <= 0:
        raise _Refused("a fluid needs nu > 0")
    moduli = {"E": 3 * lam * (1 - 2 * c["nu"]), "nu": c["nu"]}
    pressure = "converted: pressure -lam log J in place of -lam J (J - 1), equal at small changes of volume"
    return _newton(moduli, pressure, yield_stress=0.0)


_ROOT_2 = math.sqrt(2)

RULES: dict[str, dict[tuple[str, str], Rule]] = {
    "genesis": {
        ("neo_hookean", "identity"): lambda c, dt: ("MPM.Elastic", {"model": "neohooken"}, SAME),
        ("fixed_corotated", "identity"): lambda c, dt: ("MPM.Elastic", {"model": "corotation"}, SAME),
        ("fixed_corotated", "von_mises"): _genesis_von_mises,
        ("hencky", "drucker_prager"): _genesis_sand,
        ("fluid", "fluid_projection"): lambda c, dt: ("MPM.Liquid", {"viscous": False}, SAME),
        ("hencky", "viscous_flow"): _genesis_viscous,
    },
    "newton": {
        ("hencky", "identity"): lambda c, dt: _newton(c, SAME),
        ("hencky", "von_mises"): lambda c, dt: _newton(
            c, "converted: yield_stress / sqrt(2)", yield_stress=c["yield_stress"] / _ROOT_2
        ),
        ("hencky", "drucker_prager"): lambda c, dt: _newton_cone(
            c, 3 * _bulk(c) * c["cohesion"], "converted: friction = 2 sqrt(3) sin phi / (3 - sin phi)"
        ),
        ("hencky", "cohesive_drucker_prager"): _newton_cohesive,
        ("hencky", "viscous_flow"): lambda c, dt: _newton(
            c,
            "converted: yield_stress / sqrt(2)",
            yield_stress=c["yield_stress"] / _ROOT_2,
            viscosity=c["viscosity"],
        ),
        ("fluid", "fluid_projection"): _newton_fluid,
    },
    "mujoco": {
        ("stvk", "identity"): lambda c, dt: (
            "elasticity",
            {"young": c["E"], "poisson": c["nu"], "damping": 0.0},
            SAME,
            "MuJoCo 4.0 refuses elastic flexes with the integrator implicitfast. The file uses Euler",
        )
    },
}
"""Materials of each engine by the names of elasticity and plasticity."""


# ---- the other way ---------------------------------------------------------------------------------------------------

_GENESIS_DEFAULTS: dict[str, Arguments] = {
    "MPM.Elastic": {"E": 3e5, "model": "corotation"},
    "MPM.ElastoPlastic": {"E": 1e6, "use_von_mises": True, "von_mises_yield_stress": 1e4},
    "MPM.Liquid": {"E": 1e6, "viscous": False},
    "MPM.Sand": {"E": 1e6, "friction_angle": 45.0},
}
_NEWTON_DEFAULTS: Values = {
    "young_modulus": 1e15,
    "poisson_ratio": 0.3,
    "damping": 0.0,
    "friction": 0.5,
    "yield_pressure": 1e15,
    "tensile_yield_ratio": 0.0,
    "yield_stress": 0.0,
    "viscosity": 0.0,
    "hardening": 0.0,
    "dilatancy": 0.0,
}


def engine_law(
    engine: str, kind: str, arguments: Mapping[str, Any], substep: float | None = None
) -> tuple[dict[str, Any], float | None]:
    """Our law of the material of an engine: the inverse of `engine_material`.

    Args:
        kind, arguments: as of `EngineMaterial`. Arguments that are not given have the default of the engine.
        substep: time step of the engine [s], for the viscosity of Genesis.

    Returns:
        specification of the law, and its density [kg/m^3] if the material has one.

    Raises:
        InputError: unknown class or argument, or a material that we do not have.
    """
    check_engine(engine)
    spec, density = {"genesis": _of_genesis, "newton": _of_newton, "mujoco": _of_mujoco}[engine](
        kind, dict(arguments), substep
    )
    complete(spec, substep)
    return spec, density


def _checked(kind: str, given: Arguments, defaults: Mapping[str, Any], expected: str) -> dict[str, Any]:
    """Arguments with defaults. Raises InputError for an unknown one, or one that is no number in place of a number."""
    for name, value in given.items():
        if name not in defaults:
            raise InputError(f"{kind}.{name}", f"is unknown, or has no counterpart here. Expected {expected}")
        number = not isinstance(defaults[name], (str, bool))
        if number and (isinstance(value, (bool, str)) or not isinstance(value, (int, float))):
            raise InputError(f"{kind}.{name}", f"{value!r} must be a number")
    return {**defaults, **given}


def _solid(elasticity: str, E: float, nu: float, **plasticity: Any) -> dict[str, Any]:
    own = {"plasticity": plasticity} if plasticity else {}
    return {"elasticity": {"name": elasticity, "E": float(E), "nu": float(nu)}, **own}


def _of_genesis(kind: str, given: Arguments, substep: float | None):
    if kind not in _GENESIS_DEFAULTS:
        raise InputError("class", f"{kind!r} must be one of {', '.join(_GENESIS_DEFAULTS)}")
    moduli = {} if kind == "MPM.Elastic" else {"mu": math.nan, "lam": math.nan}
    defaults = {"nu": 0.2, "rho": 1000.0, **moduli, **_GENESIS_DEFAULTS[kind]}
    given = {name: value for name, value in given.items() if name != "sampler"}
    a = _checked(kind, given, defaults, ", ".join(defaults))
    E, nu, density = a["E"], a["nu"], float(a["rho"])
    if kind == "MPM.Liquid":
        mu, lam = (
            own if math.isnan(a[key]) else a[key] for key, own in zip(("mu", "lam"), lame(E, nu), strict=True)
        )
        if not a["viscous"]:
            return _solid("fluid", lam * (1 + nu) * (1 - 2 * nu) / nu, nu, name="fluid_projection"), density
        viscosity = mu * _positive("substep", substep, "s")
        bulk = lam + 2 * mu / 3
        return _solid(
            "hencky", 3 * bulk * (1 - 2 * nu), nu, name="viscous_flow", viscosity=viscosity
        ), density
    if not all(math.isnan(a[key]) for key in moduli):
        raise InputError(f"{kind}.mu", "mu and lam are not read", "Give E and nu")
    if kind == "MPM.Elastic":
        names = {"corotation": "fixed_corotated", "neohooken": "neo_hookean"}
        if a["model"] not in names:
            raise InputError(f"{kind}.model", f"{a['model']!r} must be one of {', '.join(names)}")
        return _solid(names[a["model"]], E, nu), density
    if kind == "MPM.Sand":
        return _solid(
            "hencky", E, nu, name="drucker_prager", friction_angle=float(a["friction_angle"])
        ), density
    if not a["use_von_mises"]:
        raise InputError(
            f"{kind}.use_von_mises", "limits of stretches have no counterpart here", "Use von Mises"
        )
    return _solid(
        "fixed_corotated", E, nu, name="von_mises", yield_stress=float(a["von_mises_yield_stress"])
    ), density


def _of_newton(kind: str, given: Arguments, substep: float | None):
    a = _checked("mpm", given, _NEWTON_DEFAULTS, ", ".join(_NEWTON_DEFAULTS))
    for name in ("damping", "hardening", "dilatancy"):
        if a[name] != 0:
            raise InputError(f"mpm.{name}", f"{a[name]:g} has no counterpart here", "Only 0 can be read")
    E, nu, friction = a["young_modulus"], a["poisson_ratio"], a["friction"]
    if E >= UNBOUNDED:
        raise InputError("mpm.young_modulus", f"{E:g} Pa is rigid", "Give a finite stiffness")
    strength, shear = a["tensile_yield_ratio"] * a["yield_pressure"], a["yield_stress"]
    if a["yield_pressure"] < 1e3 * E:
        raise InputError(
            "mpm.yield_pressure", f"{a['yield_pressure']:g} Pa: crushing has no counterpart here"
        )
    if shear + friction * strength >= 1e3 * E:  # never yields
        return _solid("hencky", E, nu), None
    flow = {"viscosity": float(a["viscosity"])} if a["viscosity"] else {}
    if friction == 0 and strength >= 1e3 * E:
        name = "viscous_flow" if flow else "von_mises"
        return _solid("hencky", E, nu, name=name, yield_stress=_ROOT_2 * shear, **flow), None
    if friction == 0 or shear or flow:
        problem = f"friction {friction:g}, yield_stress {shear:g} and viscosity {a['viscosity']:g} together"
        raise InputError("mpm.friction", f"{problem} have no counterpart here")
    sine = 3 * friction / (2 * math.sqrt(3) + friction)
    if not sine < 1:
        raise InputError("mpm.friction", f"{friction:g} exceeds that of a friction angle of 90 degrees, 1.73")
    cohesion = strength / (3 * _bulk({"E": E, "nu": nu}))
    angle = math.degrees(math.asin(sine))
    return _solid("hencky", E, nu, name="drucker_prager", friction_angle=angle, cohesion=cohesion), None


def _of_mujoco(kind: str, given: Arguments, substep: float | None):
    defaults = {"young": math.nan, "poisson": 0.0, "damping": 0.0}
    a = _checked(kind, given, defaults, ", ".join(defaults))
    if math.isnan(a["young"]):
        raise InputError(f"{kind}.young", "is missing", "Only flexes with an elasticity can be read")
    if a["damping"] != 0:
        raise InputError(
            f"{kind}.damping", f"{a['damping']:g} s has no counterpart here", "Only 0 can be read"
        )
    return _solid("stvk", a["young"], a["poisson"]), None
