"""Particles with a material as plain USDA text, for newton's importer, Blender and other programs. Needs no package.

The material is a ``NewtonMPMMaterialAPI``, the solver a ``NewtonMPMSceneAPI`` (newton-usd-schemas 0.6.0). Programs that
do not know these schemas show coloured points.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.extras import require
from neuma_lib.io.files import existing, reading

ATTRIBUTES = {
    "young_modulus": "youngsModulus",
    "poisson_ratio": "poissonsRatio",
    "damping": "elasticDamping",
    "friction": "internalFriction",
    "yield_pressure": "yieldPressure",
    "tensile_yield_ratio": "tensileYieldRatio",
    "yield_stress": "yieldStress",
    "viscosity": "viscosity",
    "hardening": "hardening",
    "dilatancy": "dilatancy",
}
"""Names of the schema, after ``newton:mpm:``, of newton's particle attributes ``mpm:``."""


def particle_scene(
    x: np.ndarray,
    v: np.ndarray,
    masses: np.ndarray,
    widths: np.ndarray,
    colors: np.ndarray | None,
    material: Mapping[str, float],
    *,
    density: float,
    cell: float,
    gravity: Sequence[float],
    friction: float,
    about: Mapping[str, Any],
) -> str:
    """USDA text of a body of particles above the floor y = 0, y up, in SI units.

    Args:
        x, v: positions [m] and velocities [m/s], (N, 3).
        masses: of the particles [kg], (N,).
        widths: edges of the cubes of the particles [m], (N,), whose volumes newton takes as widths^3.
        colors: linear colours in [0, 1], (N, 3), or None.
        material: newton's attributes by name, without ``mpm:`` (`ATTRIBUTES`).
        density: of the material [kg/m^3].
        cell: of the background grid [m].
        gravity: [m/s^2].
        friction: Coulomb coefficient of the floor.
        about: plain values that are kept in the metadata of the file.
    """
    strength = math.hypot(*gravity)
    down = [float(g) / strength for g in gravity] if strength else [0.0, -1.0, 0.0]
    attributes = "\n".join(f"        float newton:mpm:{ATTRIBUTES[k]} = {v:.9g}" for k, v in material.items())
    ends = f"[{_vector(x.min(axis=0) - widths.max() / 2)}, {_vector(x.max(axis=0) + widths.max() / 2)}]"
    display = "" if colors is None else (
        f'\n        color3f[] primvars:displayColor = {_vectors(colors)} (interpolation = "vertex")'
    )  # fmt: skip
    return f"""#usda 1.0
(
    customLayerData = {{
        string neuma = {json.dumps(json.dumps(about, allow_nan=False))}
    }}
    defaultPrim = "scene"
    kilogramsPerUnit = 1
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "scene"
{{
    def PhysicsScene "physics" (
        prepend apiSchemas = ["NewtonMPMSceneAPI"]
    )
    {{
        vector3f physics:gravityDirection = {_vector(down)}
        float physics:gravityMagnitude = {strength:.9g}
        float newton:mpm:voxelSize = {cell:.9g}
        float newton:mpm:airDrag = 0
        float newton:mpm:tolerance = 1e-6
    }}

    def Material "law" (
        prepend apiSchemas = ["NewtonMPMMaterialAPI"]
    )
    {{
        float physics:density = {density:.9g}
{attributes}
    }}

    def Material "ground" (
        prepend apiSchemas = ["PhysicsMaterialAPI"]
    )
    {{
        float physics:dynamicFriction = {friction:.9g}
        float physics:staticFriction = {friction:.9g}
    }}

    def Plane "floor" (
        prepend apiSchemas = ["PhysicsCollisionAPI", "MaterialBindingAPI"]
    )
    {{
        uniform token axis = "Y"
        uniform token purpose = "guide"
        rel material:binding:physics = </scene/ground>
    }}

    def Points "body" (
        prepend apiSchemas = ["MaterialBindingAPI", "NewtonPointsDeformableSimAPI", "PhysicsDeformableBodyAPI"]
    )
    {{
        float3[] extent = {ends}
        point3f[] points = {_vectors(x)}
        vector3f[] velocities = {_vectors(v)}
        float[] widths = {_list(widths)} (interpolation = "vertex")
        float[] physics:masses = {_list(masses)}{display}
        rel material:binding:physics = </scene/law>
        rel physics:simulationOwner = </scene/physics>
    }}
}}
"""


def read_material(path: str | Path) -> tuple[dict[str, float], float | None]:
    """Attributes ``mpm:`` of the only newton material of a USD file, in SI units, and its density [kg/m^3].

    Raises:
        InputError: usd-core is missing, no USD file, or not one such material.
    """
    Usd, UsdGeom, UsdPhysics = (require(f"pxr.{name}", "viewer") for name in ("Usd", "UsdGeom", "UsdPhysics"))
    path = existing(path)
    with reading(path, "USD"):
        stage = Usd.Stage.Open(str(path))
    metre, kilogram = UsdGeom.GetStageMetersPerUnit(stage), UsdPhysics.GetStageKilogramsPerUnit(stage)
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        metre = 1.0  # as newton reads it
    prims = [
        prim for prim in stage.Traverse()
        if "NewtonMPMMaterialAPI" in (prim.GetMetadata("apiSchemas").GetAppliedItems()
                                      if prim.GetMetadata("apiSchemas") else ())
    ]  # fmt: skip
    if len(prims) != 1:
        raise InputError(path, f"has {len(prims)} materials with NewtonMPMMaterialAPI, not one")

    def authored(name: str) -> float | None:
        attribute = prims[0].GetAttribute(name)
        value = attribute.Get() if attribute and attribute.HasAuthoredValue() else None
        return float(value) if isinstance(value, (int, float)) and math.isfinite(value) else None

    pascal = kilogram / metre
    units = dict.fromkeys(("young_modulus", "damping", "yield_pressure", "yield_stress", "viscosity"), pascal)
    values = {
        name: value * units.get(name, 1.0)
        for name, token in ATTRIBUTES.items()
        if (value := authored(f"newton:mpm:{token}")) is not None
    }
    density = authored("physics:density")
    return values, density * kilogram / metre**3 if density else None


def _vector(values: Sequence[float] | np.ndarray) -> str:
    return f"({_list(values)[1:-1]})"


def _list(values: Sequence[float] | np.ndarray) -> str:
    return f"[{', '.join(f'{float(value):.9g}' for value in values)}]"


def _vectors(rows: np.ndarray) -> str:
    return f"[{', '.join(map(_vector, rows.tolist()))}]"
