"""Deformable bodies of MuJoCo as MJCF text: a flex of tetrahedra, and its constants read back."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, one_line, reading

MAX_BYTES = 1 << 28  # size of a file that is read


def flex_scene(
    vertices: np.ndarray,
    tetrahedra: np.ndarray,
    masses: np.ndarray,
    elasticity: Mapping[str, float],
    *,
    radius: float,
    dt: float,
    gravity: Sequence[float],
    friction: float,
    about: Mapping[str, str],
) -> str:
    """MJCF of a deformable body above the floor y = 0, with one body of three slides for each vertex.

    A ``flexcomp`` would expand to the same with equal masses at all vertices. Here masses are given.

    Args:
        vertices: positions [m], (N, 3).
        tetrahedra: indices of vertices, positively oriented, (M, 4).
        masses: of the vertices [kg], (N,).
        elasticity: ``young`` [Pa], ``poisson`` and ``damping`` [s].
        radius: distance from a vertex at which contact starts [m].
        dt: time step [s].
        gravity: [m/s^2].
        friction: Coulomb coefficient of the floor.
        about: texts of a comment by name.
    """
    comment = "\n".join(f"  {key}: {value}" for key, value in about.items()).replace("--", "- -")
    slides = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    bodies = "\n".join(
        f'    <body name="v{k}" pos="{_numbers(x)}"><inertial pos="0 0 0" mass="{m:.9g}" '
        f'diaginertia="{_numbers([1e-3 * m * radius**2] * 3)}"/>{slides}</body>'
        for k, (x, m) in enumerate(zip(vertices, masses, strict=True))
    )
    # cone="elliptic": with pyramids, bodies fall through a floor of a coefficient above 2
    return f"""<mujoco model="neuma">
  <!--
{comment}
  -->
  <option timestep="{dt:.9g}" gravity="{_numbers(gravity)}" integrator="Euler" cone="elliptic"/>
  <size memory="200M"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1" zaxis="0 1 0" friction="{friction:.9g} 0 0" condim="3"/>
{bodies}
  </worldbody>
  <deformable>
    <flex name="body" dim="3" radius="{radius:.9g}" body="{" ".join(f"v{k}" for k in range(len(vertices)))}"
          element="{" ".join(map(str, tetrahedra.ravel().tolist()))}">
      <contact selfcollide="none" friction="{friction:.9g} 0 0" condim="3"/>
      <elasticity {" ".join(f'{key}="{value:.9g}"' for key, value in elasticity.items())}/>
    </flex>
  </deformable>
</mujoco>
"""


def read_elasticity(path: str | Path) -> dict[str, Any]:
    """Attributes of the elasticity of the only flex, or flexcomp, of an MJCF file.

    Raises:
        InputError: no XML, not one such flex, one of cloth, or an attribute that is no number.
    """
    path = existing(path)
    if path.stat().st_size > MAX_BYTES or b"<!ENTITY" in (content := path.read_bytes()):
        raise InputError(path, f"an MJCF file must have no entities and at most {MAX_BYTES >> 20} MiB")
    with reading(path, "XML"):
        root = ElementTree.fromstring(content)
    flexes = [flex for tag in ("flexcomp", "flex") for flex in root.iter(tag)]
    if len(flexes) != 1:
        raise InputError(path, f"has {len(flexes)} flexes, not one")
    (flex,) = flexes
    if flex.get("dim", "2") != "3":
        raise InputError(path, "its flex is no solid", 'Only flexes with dim="3" can be read')
    edge, elasticity = flex.find("edge"), flex.find("elasticity")
    if edge is not None and edge.keys():
        raise InputError(path, f"its edges have {', '.join(edge.keys())}, which is no part of a solid's law")
    values = {} if elasticity is None else dict(elasticity.items())
    try:
        numbers = {key: float(value) for key, value in values.items()}
        if not all(math.isfinite(value) for value in numbers.values()):
            raise ValueError("not finite")
    except ValueError:
        raise InputError(path, f"its elasticity {one_line(values)} must have numbers only") from None
    return numbers


def _numbers(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{float(value):.9g}" for value in values)
