"""Our analytic laws as materials of other engines, and their materials as our laws. Needs no engine.

`RULES` maps them, docs/engines.md has the table. Sources: classes of genesis-world 1.4.5, kernels of newton 1.8.0
(``rheology_solver_kernels.py``), and the documentation of MuJoCo 4.0.0. newton limits |dev tau| to
sqrt(2) (yield_stress + friction p), since its stress is a vector whose squared norm is half that of the tensor. All
engines sum stresses over the volume of undeformed particles or elements.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from neuma_lib.errors import InputError
from neuma_lib.mechanics.catalogue import ELASTICITY, PLASTICITY, check_constants, complete, lame

ENGINES = ("genesis", "newton", "mujoco")
UNBOUNDED = 1e12
"""Yield stress of a newton material that never yields, and pressure at which it is crushed [Pa]."""
MAX_RELAXATION = 0.01
"""Longest relaxation time of the shear of a viscous law that a fluid without elastic shear replaces [s]."""
_SAME_MODULI = 1e-6  # relative difference up to which moduli of both parts of a law are equal

Values = dict[str, float]
Names = tuple[str, str]  # of the elasticity and of the plasticity
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
    for part in parts.keys() - {"elasticity", "plasticity"}:
        problem = f"{engine} has no such material: its solids have no {parts[part]['name']}"
        raise InputError(part, problem, "Export the law without this part")
    names = (parts["elasticity"]["name"], parts["plasticity"]["name"])
    elastic, plastic = (
        check_constants(part, known[values["name"]], {k: v for k, v in values.items() if k != "name"})
        for (part, values), known in zip(parts.items(), (ELASTICITY, PLASTICITY), strict=True)
    )
    for key in ("E", "nu"):
        if abs(plastic.get(key, elastic[key]) - elastic[key]) > _SAME_MODULI * abs(elastic[key]):
            problem = f"{plastic[key]:g} must equal elasticity.{key} = {elastic[key]:g} in {engine}"
            raise InputError(f"plasticity.{key}", problem)
    constants = {**elastic, **plastic}
    if (problem := _refusal(engine, names, constants)) is not None:
        others = [other for other in ENGINES if _refusal(other, names, constants) is None]
        remedy = f"{' and '.join(others) or 'No engine'} can. --fit fits the nearest one"
        raise InputError(f"law {' + '.join(names)}", f"{engine} has no such material: {problem}", remedy)
    kind, arguments, *notes = RULES[engine][names](constants, substep)
    if engine == "genesis":
        arguments = {"E": constants["E"], "nu": constants["nu"], "rho": density, **arguments}
    return EngineMaterial(kind, arguments, tuple(notes))


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


def _refusal(engine: str, names: Names, constants: Values) -> str | None:
    """Why an engine does not have a law with these constants, or None."""
    if names not in RULES[engine]:
        return f"it has {', '.join(map(' + '.join, RULES[engine]))}"
    able, problem = _LIMITS.get((engine, names[1]), (lambda c: True, None))
    return None if able(constants) else problem


# ---- rules: constants of a law and the time step [s] -> class, arguments, notes -------------------------------------

SAME = "same formula"
_ROOT_2 = math.sqrt(2)
_NO_LIMITS = {
    "damping": 0.0,
    "friction": 0.0,
    "yield_pressure": UNBOUNDED,
    "tensile_yield_ratio": 1.0,
    "yield_stress": UNBOUNDED,
    "viscosity": 0.0,
    "hardening": 0.0,
    "dilatancy": 0.0,
}
"""newton's attributes other than the moduli, all of which it gives other defaults."""


def _bulk(c: Values) -> float:
    """Bulk modulus [Pa]."""
    return c["E"] / (3 * (1 - 2 * c["nu"]))


def _genesis(kind: str, *notes: str, **arguments: Any):
    return (f"MPM.{kind}", arguments, *notes)


def _genesis_viscous(c: Values, dt: float):
    mu = c["viscosity"] / dt
    return _genesis(
        "Liquid",
        f"converted: mu = viscosity / substep and lam = K - 2 mu / 3 hold at a substep of {dt:g} s only",
        f"without the elastic shear of our law, which relaxes in {c['viscosity'] / lame(c['E'], c['nu'])[0]:.2g} s",
        viscous=True,
        mu=mu,
        lam=_bulk(c) - 2 * mu / 3,
    )


def _newton(c: Values, formula: str, **limits: float):
    """A newton material. Limits that are not given do not act."""
    step = "newton's implicit step damps in proportion to it. Halve it until the motion no longer changes"
    moduli = {"young_modulus": c["E"], "poisson_ratio": c["nu"]}
    return "mpm", {**moduli, **_NO_LIMITS, **limits}, formula, step


def _newton_metal(c: Values, **others: float):
    return _newton(c, "converted: yield_stress / sqrt(2)", yield_stress=c["yield_stress"] / _ROOT_2, **others)


def _newton_cone(c: Values, strength: float):
    """A Drucker-Prager cone with a tensile strength [Pa] at its apex."""
    sine = math.sin(math.radians(c["friction_angle"]))
    limits = {"yield_stress": 0.0, "tensile_yield_ratio": strength / UNBOUNDED}
    formula = "converted: friction = 2 sqrt(3) sin phi / (3 - sin phi), cohesion as the tensile strength of the cone"
    return _newton(c, formula, friction=2 * math.sqrt(3) * sine / (3 - sine), **limits)


def _newton_fluid(c: Values):
    moduli = {"E": 3 * lame(c["E"], c["nu"])[1] * (1 - 2 * c["nu"]), "nu": c["nu"]}
    formula = "converted: pressure -lam log J in place of -lam J (J - 1), equal at small changes of volume"
    return _newton(moduli, formula, yield_stress=0.0)


RULES: dict[str, dict[Names, Callable[[Values, float], tuple[Any, ...]]]] = {
    "genesis": {
        ("neo_hookean", "identity"): lambda c, dt: _genesis("Elastic", SAME, model="neohooken"),
        ("fixed_corotated", "identity"): lambda c, dt: _genesis("Elastic", SAME, model="corotation"),
        ("fixed_corotated", "von_mises"): lambda c, dt: _genesis(
            "ElastoPlastic",
            SAME,
            "Genesis limits singular values to at least 0.05",
            use_von_mises=True,
            von_mises_yield_stress=c["yield_stress"],
        ),
        ("hencky", "drucker_prager"): lambda c, dt: _genesis(
            "Sand",
            "converted: same cone and stress. After an expansion Genesis compacts by the same volume before it resists",
            friction_angle=c["friction_angle"],
        ),
        ("fluid", "fluid_projection"): lambda c, dt: _genesis("Liquid", SAME, viscous=False),
        ("hencky", "viscous_flow"): _genesis_viscous,
    },
    "newton": {
        ("hencky", "identity"): lambda c, dt: _newton(c, SAME),
        ("hencky", "von_mises"): lambda c, dt: _newton_metal(c),
        ("hencky", "drucker_prager"): lambda c, dt: _newton_cone(c, 3 * _bulk(c) * c["cohesion"]),
        ("hencky", "cohesive_drucker_prager"): lambda c, dt: _newton_cone(
            c, c["cohesion"] / math.tan(math.radians(c["friction_angle"]))
        ),
        ("hencky", "viscous_flow"): lambda c, dt: _newton_metal(c, viscosity=c["viscosity"]),
        ("fluid", "fluid_projection"): lambda c, dt: _newton_fluid(c),
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
_LIMITS: dict[Names, tuple[Callable[[Values], bool], str]] = {
    ("genesis", "von_mises"): (lambda c: c["yield_stress"] > 0, "its yield_stress must be greater than 0 Pa"),
    ("genesis", "drucker_prager"): (lambda c: c["cohesion"] == 0, "MPM.Sand has no cohesion"),
    ("genesis", "viscous_flow"): (
        lambda c: c["yield_stress"] == 0 and c["viscosity"] <= MAX_RELAXATION * lame(c["E"], c["nu"])[0],
        f"MPM.Liquid has no yield stress and no elastic shear that relaxes in more than {MAX_RELAXATION:g} s",
    ),
    ("newton", "cohesive_drucker_prager"): (
        lambda c: c["dilation_angle"] == 0,
        "the dilatancy of newton is not the dilation angle",
    ),
    ("newton", "fluid_projection"): (lambda c: c["nu"] > 0, "a fluid needs nu > 0"),
}
"""Constants that the materials of an engine need, by engine and plasticity."""


# ---- the other way ---------------------------------------------------------------------------------------------------

_GENESIS_DEFAULTS: dict[str, dict[str, Any]] = {
    "MPM.Elastic": {"E": 3e5, "model": "corotation"},
    "MPM.ElastoPlastic": {"E": 1e6, "use_von_mises": True, "von_mises_yield_stress": 1e4},
    "MPM.Liquid": {"E": 1e6, "viscous": False, "mu": math.nan, "lam": math.nan},
    "MPM.Sand": {"E": 1e6, "friction_angle": 45.0},
}
_NEWTON_DEFAULTS = {name: 0.0 for name in _NO_LIMITS} | {
    "young_modulus": 1e15,
    "poisson_ratio": 0.3,
    "friction": 0.5,
    "yield_pressure": 1e15,
}
_MUJOCO_DEFAULTS = {"young": math.nan, "poisson": 0.0, "damping": 0.0}


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
    if engine == "genesis":
        if kind not in _GENESIS_DEFAULTS:
            raise InputError("class", f"{kind!r} must be one of {', '.join(_GENESIS_DEFAULTS)}")
        given = {name: value for name, value in arguments.items() if name != "sampler"}
        a = _checked(kind, given, {"nu": 0.2, "rho": 1000.0, **_GENESIS_DEFAULTS[kind]})
        spec, density = _of_genesis(kind, a, substep), float(a["rho"])
    elif engine == "newton":
        spec, density = _of_newton(_checked("mpm", arguments, _NEWTON_DEFAULTS)), None
    else:
        a = _checked("elasticity", arguments, _MUJOCO_DEFAULTS)
        if math.isnan(a["young"]):
            raise InputError("elasticity.young", "is missing", "Only flexes with an elasticity can be read")
        spec, density = _solid("stvk", a["young"], a["poisson"]), None
    complete(spec, substep)
    return spec, density


def _checked(kind: str, given: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments with defaults. Raises InputError for one that is unknown, no number, or must be zero."""
    for name, value in given.items():
        if name not in defaults:
            problem = f"is unknown, or has no counterpart here. Expected {', '.join(defaults)}"
            raise InputError(f"{kind}.{name}", problem)
        number = not isinstance(defaults[name], (str, bool))
        if number and (isinstance(value, bool) or not isinstance(value, (int, float))):
            raise InputError(f"{kind}.{name}", f"{value!r} must be a number")
        if name in ("damping", "hardening", "dilatancy") and value != 0:
            raise InputError(f"{kind}.{name}", f"{value:g} has no counterpart here", "Only 0 can be read")
    return {**defaults, **given}


def _solid(elasticity: str, E: float, nu: float, **plasticity: Any) -> dict[str, Any]:
    own = {"plasticity": plasticity} if plasticity else {}
    return {"elasticity": {"name": elasticity, "E": float(E), "nu": float(nu)}, **own}


def _of_genesis(kind: str, a: dict[str, Any], substep: float | None) -> dict[str, Any]:
    E, nu = a["E"], a["nu"]
    if kind == "MPM.Liquid":
        mu, lam = (
            b if math.isnan(a[key]) else a[key] for key, b in zip(("mu", "lam"), lame(E, nu), strict=True)
        )
        if not a["viscous"]:
            return _solid("fluid", lam * (1 + nu) * (1 - 2 * nu) / nu, nu, name="fluid_projection")
        viscosity = mu * _positive("substep", substep, "s")
        E = (3 * lam + 2 * mu) * (1 - 2 * nu)
        return _solid("hencky", E, nu, name="viscous_flow", viscosity=viscosity)
    if kind == "MPM.Elastic":
        names = {"corotation": "fixed_corotated", "neohooken": "neo_hookean"}
        if a["model"] not in names:
            raise InputError(f"{kind}.model", f"{a['model']!r} must be one of {', '.join(names)}")
        return _solid(names[a["model"]], E, nu)
    if kind == "MPM.Sand":
        return _solid("hencky", E, nu, name="drucker_prager", friction_angle=float(a["friction_angle"]))
    if not a["use_von_mises"]:
        problem = "limits of stretches have no counterpart here"
        raise InputError(f"{kind}.use_von_mises", problem, "Use von Mises")
    return _solid("fixed_corotated", E, nu, name="von_mises", yield_stress=float(a["von_mises_yield_stress"]))


def _of_newton(a: dict[str, Any]) -> dict[str, Any]:
    E, nu, friction, shear = (
        a[key] for key in ("young_modulus", "poisson_ratio", "friction", "yield_stress")
    )
    strength, never = a["tensile_yield_ratio"] * a["yield_pressure"], 1e3 * E
    if E >= UNBOUNDED:
        raise InputError("mpm.young_modulus", f"{E:g} Pa is rigid", "Give a finite stiffness")
    if a["yield_pressure"] < never:
        problem = f"{a['yield_pressure']:g} Pa: crushing has no counterpart here"
        raise InputError("mpm.yield_pressure", problem)
    if shear + friction * strength >= never:
        return _solid("hencky", E, nu)
    flow = {"viscosity": float(a["viscosity"])} if a["viscosity"] else {}
    if friction == 0 and strength >= never:
        name = "viscous_flow" if flow else "von_mises"
        return _solid("hencky", E, nu, name=name, yield_stress=_ROOT_2 * shear, **flow)
    if friction == 0 or shear or flow:
        problem = f"friction {friction:g}, yield_stress {shear:g} and viscosity {a['viscosity']:g} together"
        raise InputError("mpm.friction", f"{problem} have no counterpart here")
    sine = 3 * friction / (2 * math.sqrt(3) + friction)
    if not sine < 1:
        raise InputError("mpm.friction", f"{friction:g} exceeds that of a friction angle of 90 degrees, 1.73")
    angle, cohesion = math.degrees(math.asin(sine)), strength / (3 * _bulk({"E": E, "nu": nu}))
    return _solid("hencky", E, nu, name="drucker_prager", friction_angle=angle, cohesion=cohesion)
