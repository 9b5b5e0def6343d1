"""A body with its law, start and floor as a scene of another engine: files of the engine, and a script that plays them.

A folder has ``scene.json`` (material, law, notes and times), ``body.npz`` (start), ``scene.usda`` for newton or
``scene.xml`` for MuJoCo, and ``run.py``, which needs the engine and NumPy only. It writes ``motion.npz`` with positions
``x`` (T, N, 3) [m] at the times ``t`` (T,) [s], y up: of the particles, or for MuJoCo of the vertices of the mesh.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from neuma_lib.errors import InputError
from neuma_lib.export.materials import EngineMaterial, check_engine, engine_material
from neuma_lib.io.files import atomic, write_json, write_text
from neuma_lib.io.gltf import linear
from neuma_lib.io.mjcf import flex_scene
from neuma_lib.io.usd_particles import particle_scene
from neuma_lib.sim.model import MPM
from neuma_lib.sim.state import State
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.spherical_harmonics import sh0_to_rgb

CONTACT = "Contact is no part of a law. It is that of the engine, so that rebounds differ"
MAX_UNEVEN, MAX_SPREAD = 1e-3, 0.2
"""Largest relative difference of densities that count as one, and standard deviation of volumes over their mean."""
SCENE_FILES = {"newton": "scene.usda", "mujoco": "scene.xml"}
"""File of a scene that an engine loads itself. A script builds those of Genesis."""
STICKS = 1e3  # Coulomb coefficient of a floor on which nothing slides
SAMPLE_EDGE, SAMPLE_COUNT, SAMPLE_HEIGHT = 0.2, 16, 0.1
"""Edge [m], particles along it, and height above the floor [m] of the cube in the file of a law alone."""
_KUHN = np.array([[0, 4, 6, 7], [0, 5, 4, 7], [0, 6, 2, 7], [0, 2, 3, 7], [0, 1, 5, 7], [0, 3, 1, 7]])
"""Six tetrahedra of a cube whose corners are numbered by 4 i + 2 j + k, positively oriented (Kuhn 1960)."""


@dataclass(frozen=True)
class EngineScene:
    """A body above the floor y = 0."""

    # x, v: positions [m] and velocities [m/s] of the particles, (N, 3)
    x: np.ndarray
    v: np.ndarray
    # mass, vol0: masses [kg] and undeformed volumes [m^3] of the particles, (N,)
    mass: np.ndarray
    vol0: np.ndarray
    dt: float  # time step [s]
    # steps, every: number of steps, and steps from one recorded state to the next
    steps: int
    every: int
    grid: int  # cells per metre
    gravity: tuple[float, float, float] = (0.0, -9.8, 0.0)  # [m/s^2]
    friction: float = STICKS  # Coulomb coefficient of the floor
    colors: np.ndarray | None = None  # linear colours of the particles in [0, 1], (N, 3), or None
    notes: tuple[str, ...] = ()  # what of the scene is not carried over

    @classmethod
    def of(
        cls, mpm: MPM, state: State, steps: int, every: int, gaussians: Gaussians | None = None
    ) -> "EngineScene":
        """The scene of a simulation.

        Raises:
            InputError: colliders, clamps or a deformed start, which other engines do not get.
        """
        for name in ("colliders", "clamps"):
            if getattr(mpm, name):
                raise InputError(f"scene.{name}", "cannot be exported", "Export a scene with a floor only")
        x, v, mass, vol0, F, C = (
            each.detach().cpu().double().numpy() for each in (state.x, state.motion[1], state.mass, state.vol0,
                                                              state.F, state.C)
        )  # fmt: skip
        if np.abs(F - np.eye(3)).max() > 1e-6:
            raise InputError("scene.start", "is deformed", "Export the start of the motion")
        notes = ["only the wall y_min of the unit cube is carried over, as an infinite floor"]
        if mpm.contact != "particles":
            notes.append(f"contact of {mpm.contact} is not carried over: it starts away from the floor")
        if C.any():
            notes.append("affine velocities of particles start at zero, which slows a spin in the first step")
        wall = mpm.boundary[2]
        friction = min({"no_slip": STICKS, "sticky": STICKS, "slip": 0.0}.get(wall, wall), STICKS)
        colors = None if gaussians is None else _colors(x, gaussians)
        own = (mpm.dt, steps, every, mpm.grid, mpm.gravity, float(friction))
        return cls(x, v, mass, vol0, *own, colors, tuple(notes))

    @classmethod
    def falling_cube(cls, density: float, dt: float, seconds: float = 0.5) -> "EngineScene":
        """A cube above a frictionless floor, the body of files that show a law alone."""
        spacing = SAMPLE_EDGE / SAMPLE_COUNT
        sites = np.indices((SAMPLE_COUNT,) * 3).reshape(3, -1).T - (SAMPLE_COUNT - 1) / 2
        x = sites * spacing + [0.5, SAMPLE_HEIGHT + SAMPLE_EDGE / 2, 0.5]
        vol0, steps, every = np.full(len(x), spacing**3), round(seconds / dt), max(1, round(5e-3 / dt))
        own = (dt, steps, every, round(0.5 / spacing))
        return cls(x, np.zeros_like(x), density * vol0, vol0, *own, friction=0.0)

    @property
    def density(self) -> float:
        """Density of the body [kg/m^3]. Raises InputError if it is not uniform."""
        each = self.mass / self.vol0
        if np.ptp(each) > MAX_UNEVEN * each.mean():
            problem = f"{each.min():.4g} to {each.max():.4g} kg/m^3 is not uniform"
            raise InputError("density", problem, "Other engines get bodies of one density only")
        return float(self.mass.sum() / self.vol0.sum())


def write_law_scene(
    path: str | Path, engine: str, material: EngineMaterial, about: Mapping[str, Any]
) -> list[str]:
    """Write a file that the engine loads, ``.usda`` or ``.xml`` of a falling cube, or ``.json`` of the material alone.

    Returns the notes.

    Args:
        about: as of `neuma_lib.export.laws.law_for_engine`.

    Raises:
        InputError: a suffix that the engine does not read.
    """
    content, own = _about(engine, material, about), Path(SCENE_FILES.get(engine, ".json")).suffix
    if Path(path).suffix == ".json":
        write_json(path, content)
    elif Path(path).suffix == own:
        write_text(
            path,
            _text(engine, EngineScene.falling_cube(about["density"], about["substep"]), material, content),
        )
    else:
        wanted = " or ".join(dict.fromkeys((".json", own)))
        raise InputError(path, f"{engine} reads {wanted}", "Give the file that suffix")
    return content["notes"]


def export_scene(
    folder: str | Path, engine: str, scene: EngineScene, spec: Mapping[str, Any], about: Mapping[str, Any]
) -> list[str]:
    """Write a folder with the scene and the script that plays it.

    Args:
        folder: created if needed.
        engine: one of `neuma_lib.export.materials.ENGINES`.
        spec: the law, as of `Law.from_spec`.
        about: what is known of the law, with the keys of `neuma_lib.io.exported`.

    Returns:
        the notes.

    Raises:
        InputError: the engine has no such material, or the body has no uniform density, or its particles
            too different volumes.
    """
    check_engine(engine)
    material = engine_material(spec, scene.density, scene.dt, engine)
    folder, notes = Path(folder), (*material.notes, *scene.notes)
    spread = float(scene.vol0.std() / scene.vol0.mean())
    if spread > MAX_SPREAD:
        problem = f"volumes with a standard deviation of {100 * spread:.0f} % of the mean are not supported"
        raise InputError("particles", problem, f"Use particles with less than {100 * MAX_SPREAD:.0f} %")
    if engine == "genesis" and spread > 1e-3:
        notes += (f"all particles get the mean volume, from which theirs differ by {100 * spread:.0f} %",)
    content = _about(engine, material._replace(notes=notes), {**about, "law": spec, "density": scene.density})
    times = {name: getattr(scene, name) for name in ("dt", "steps", "every", "grid", "gravity")}
    body = {name: getattr(scene, name) for name in ("x", "v", "mass", "vol0")}
    if engine in SCENE_FILES:
        write_text(folder / SCENE_FILES[engine], _text(engine, scene, material, content))
    if engine == "mujoco":
        body["v"] = _mesh(scene)[3]
    write_json(folder / "scene.json", {**content, **times, "floor": {"friction": scene.friction}})
    with atomic(folder / "body.npz") as partial, partial.open("wb") as file:
        np.savez(file, **body)
    script = Path(__file__).with_name("players") / f"{engine}.py"
    write_text(folder / "run.py", script.read_text())
    return content["notes"]


def _about(engine: str, material: EngineMaterial, about: Mapping[str, Any]) -> dict[str, Any]:
    grid = about.get("grid")
    fitted = f"fitted on a grid of {grid} cells, whose error they contain"
    notes = [*material.notes, f"constants {'of the material' if grid is None else fitted}", CONTACT]
    if errors := about.get("fit"):
        percent = " and after the return map ".join(f"{100 * error:.1f} %" for error in errors.values())
        notes.insert(0, f"nearest law of {engine}: stress error of the fit over the visited states {percent}")
    keys = ("law", "constants", "density", "scale", "substep", "fit", "scene", "method", "commit")
    return {
        "engine": engine,
        "class": material.kind,
        "arguments": material.arguments,
        "notes": notes,
        "grid_of_law": grid,
        **{key: about.get(key) for key in keys},
    }


def _text(engine: str, scene: EngineScene, material: EngineMaterial, about: Mapping[str, Any]) -> str:
    """Text of the file that an engine loads, `SCENE_FILES`."""
    shared = dict(gravity=scene.gravity, friction=scene.friction)
    if engine == "newton":
        body = (scene.x, scene.v, scene.mass, scene.vol0 ** (1 / 3), scene.colors)
        more = dict(density=scene.density, cell=1 / scene.grid, about=about, **shared)
        return particle_scene(*body, material.arguments, **more)
    vertices, tetrahedra, masses, _, cell = _mesh(scene)
    words = {key: json.dumps(value) for key, value in about.items() if value is not None}
    more = dict(radius=0.02 * cell, dt=scene.dt, about=words, **shared)
    return flex_scene(vertices, tetrahedra, masses, material.arguments, **more)


def _mesh(scene: EngineScene) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """Tetrahedral mesh of the body: cubes with at least half of the particles that fill one, six tetrahedra each.

    Returns:
        vertices (N, 3) [m], tetrahedra (M, 4), lumped masses (N,) [kg] with the mass of the body, velocities of the
        vertices (N, 3) [m/s], and the edge of a cube [m].
    """
    cell = 2 * float(scene.vol0.mean()) ** (1 / 3)
    lowest = scene.x.min(axis=0) - cell / 4
    cells, counts = np.unique(
        np.floor((scene.x - lowest) / cell + 1e-9).astype(int), axis=0, return_counts=True
    )
    cells = cells[counts >= 4]
    if not len(cells):
        raise InputError("particles", "no cube of the mesh is filled", "Use more particles")
    corners = cells[:, None] + np.indices((2, 2, 2)).reshape(3, 8).T
    sites, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    index = index.reshape(len(cells), 8)
    tetrahedra = index[:, _KUHN].reshape(-1, 4)
    share = scene.mass.sum() / len(tetrahedra) / 4
    masses = np.bincount(tetrahedra.ravel(), minlength=len(sites)) * share
    vertices = lowest + cell * sites
    return vertices, tetrahedra, masses, scene.v[cKDTree(scene.x).query(vertices)[1]], cell


def _colors(x: np.ndarray, gaussians: Gaussians) -> np.ndarray:
    """Linear colours (N, 3) of the nearest Gaussians of points x (N, 3)."""
    nearest: Sequence[int] = cKDTree(gaussians.means.detach().cpu().numpy()).query(x)[1]
    return linear(sh0_to_rgb(gaussians.sh0.detach().cpu().double())[nearest, 0].numpy())
