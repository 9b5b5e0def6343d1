"""Laws of this project as materials of other engines, with what is known of them, and back."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.export.materials import EngineMaterial, check_engine, engine_law, engine_material
from neuma_lib.export.nearest import MAX_ERROR, nearest, sampled_states
from neuma_lib.io.exported import about_law, check_step
from neuma_lib.io.files import existing, one_line, read_json
from neuma_lib.io.laws import save_law
from neuma_lib.io.mjcf import read_elasticity
from neuma_lib.io.usd_particles import read_material
from neuma_lib.mechanics.adaptor import AdaptableLaw
from neuma_lib.mechanics.analytic import analytic_law, specification
from neuma_lib.mechanics.catalogue import at_length_scale
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.structured import StructuredLaw


def law_for_engine(
    law: Law,
    known: Mapping[str, Any],
    engine: str,
    *,
    density: float | None = None,
    substep: float | None = None,
    fit: bool = False,
    force: bool = False,
    world: bool = False,
    states: Tensor | None = None,
) -> tuple[EngineMaterial, dict[str, Any]]:
    """The material of an engine for any law, and what its files state.

    Args:
        law: analytic, or any law with ``fit``.
        known: what is known of it, with the keys of `neuma_lib.io.exported`.
        engine: one of `neuma_lib.export.materials.ENGINES`.
        density, substep: [kg/m^3] and [s]. None: those of the training.
        fit: take the nearest law that the engine has, over the visited states.
        force: accept a fit whose stress error exceeds `MAX_ERROR`.
        world: convert a law of a scaled simulator to metres of the filmed world.
        states: visited elastic states (N, 3, 3). None: samples of the recorded ranges.

    Returns:
        the material, and the content of ``known`` with ``law`` (specification), ``density``, ``substep``, ``scale`` and
        ``fit`` (relative stress errors, or None).

    Raises:
        InputError: the engine has no such material, density or step is missing, the law is of another scale, or a fit
            is too inaccurate.
    """
    check_engine(engine)
    density = known.get("density") if density is None else density
    substep = known.get("dt") if substep is None else substep
    errors = None
    if fit:
        spec, errors = _fitted(law, known, engine, states, force, substep)
    elif isinstance(law, AdaptableLaw):
        problem = f"{engine} has no {'structured laws' if isinstance(law, StructuredLaw) else 'networks'}"
        raise InputError(f"law {law.name}", problem, "Fit the nearest law that it has with --fit")
    else:
        spec = specification(law.elasticity, law.plasticity, law.viscosity, law.field)
    scale = known.get("scale") or 1.0
    if scale != 1.0 and not world:
        problem = f"a metre of its simulator is {1 / scale:.4g} m of the filmed world, which has other moduli"
        raise InputError(f"law {law.name}", problem, "Convert it with --world, or export the scene")
    if scale != 1.0:
        spec = at_length_scale(spec, 1 / scale)
    about = {**known, "law": spec, "density": density, "substep": substep, "scale": 1.0, "fit": errors}
    if fit or world:  # other constants than those that were estimated
        about["constants"] = None
    return engine_material(spec, density, substep, engine), about


def import_law(path: str | Path, target: str | Path, *, substep: float | None = None) -> dict[str, Any]:
    """Write the material of another engine as a law's file, and return its specification.

    Args:
        path: ``.json`` with ``engine``, ``class`` and ``arguments``, ``.usda``, ``.usdc`` or ``.usd`` with a newton
            material, or ``.xml`` with a MuJoCo flex.
        target: ``.safetensors``.
        substep: time step of the engine [s], for the viscosity of Genesis.

    Raises:
        InputError: the file cannot be read, or its material has no counterpart here.
    """
    path, own = existing(path, "Give a .json, .usda or .xml file"), None
    if Path(target).suffix != ".safetensors":
        raise InputError(target, "the suffix is not .safetensors", "Give the file that suffix")
    if path.suffix == ".json":
        content = read_json(path)
        names = {"engine": str, "class": str, "arguments": dict}
        if not isinstance(content, dict) or not all(
            isinstance(content.get(key), kind) for key, kind in names.items()
        ):
            raise InputError(path, "must have the texts engine and class, and arguments by name")
        material, own = [content[key] for key in names], content.get("density")
        substep = content.get("substep") if substep is None else substep
    elif path.suffix in (".usda", ".usdc", ".usd"):
        values, own = read_material(path)
        material = ["newton", "mpm", values]
    elif path.suffix == ".xml":
        material = ["mujoco", "elasticity", read_elasticity(path)]
    else:
        problem = f"{one_line(path.suffix) or 'no suffix'} is not .json, .usda, .usdc, .usd or .xml"
        raise InputError(path, problem)
    check_step("substep", substep)
    spec, density = engine_law(*material, substep=substep)
    law = analytic_law(spec, substep or 1e-3)
    save_law(target, law, about_law(law, substep, density=own if density is None else density))
    return spec


def _fitted(law: Law, known, engine: str, states: Tensor | None, force: bool, substep: float | None):
    """Specification and relative stress errors of the nearest law."""
    if states is None:
        if not known.get("visited"):
            problem = "does not state the states that it has visited"
            raise InputError(f"law {law.name}", problem, "Export it from the folder of its method")
        states = sampled_states(known["visited"])
    fit = nearest(law, states, engine, known.get("dt") or substep or 1e-3)
    if fit.error > MAX_ERROR and not force:
        names, percent = " + ".join(part["name"] for part in fit.spec.values()), 100 * fit.error
        problem = f"the nearest law of {engine}, {names}, has a stress error of {percent:.0f} % over the visited states"
        limit = f"more than {100 * MAX_ERROR:.0f} %"
        problem = f"{problem}, {limit}"
        raise InputError(f"law {law.name}", problem, "Accept it with --force, or choose another engine")
    return fit.spec, fit.errors
