"""New settings files of a project: a scene, a capture."""

from __future__ import annotations

import re
from pathlib import Path

from neuma_lib.config.variants import name_problem
from neuma_lib.errors import InputError
from neuma_lib.project.capture_scenes import scene_name
from neuma_lib.project.settings import Config

SCENE = """\
# yaml-language-server: $schema=schema.json
# Settings of the scene {name}, on top of config/config.yaml. All keys: docs/settings.md.
#   neuma check config/{name}.yaml
#   snakemake --cores 2 --configfile config/{name}.yaml -- results/{name}/film.mp4 results/{name}/viewer.html

scenes:
  {name}:
    # What is filmed. The box is a cube of 1 m: x to the right, y up, z towards the first camera, floor at y = 0.
    shape: duck                     # ball, duck, pawn, cat, bottle, fish, or letter_A ... letter_Z
    size: 0.36                      # longest side [m]
    center: [0.45, 0.5]             # x and z of the centre [m]
    height: 0.40                    # y of the centre [m]
    velocity: [0.4, -1.5, 0.0]      # initial velocity [m/s]
    spin: [0.0, 0.0, 0.0]           # initial angular velocity [rad/s]
    density: 1000                   # [kg/m^3]

    # The true material. It makes the video and is hidden from the methods.
    law:
      elasticity: {{name: neo_hookean, E: 5.0e+4, nu: 0.35}}   # Young's modulus [Pa], Poisson's ratio
      plasticity: {{name: identity}}                          # or for example {{name: von_mises, yield_stress: 5.0e+3}}

    # The material that a method starts from: jelly, plasticine or sand (priors.laws).
    prior: jelly

    # A video of `steps` time steps of `dt` seconds. `neuma check` reports a time step that is too long.
    dt: 1.0e-3
    steps: 256

    # How Blender renders it: `body` and other parts of the shape have their own colours.
    appearance:
      kind: solid                   # solid, grains or liquid
      colors: {{body: "#f4c534", wing: "#e8a528", beak: "#e8742c", eye: "#2b2522"}}
      accent: "#d98a24"
      contrast: 0.5
"""

CAPTURE = """\
# The capture {name}: photographs and videos of one object. docs/capture.md describes each step.
#   photos/             30 to 60 photographs of the object at rest on or next to the printed board
#   stills/<camera>.png a picture of the empty scene for each fixed camera
#   videos/<camera>.mp4 a fall, filmed by each fixed camera; several falls: videos/<fall>/<camera>.mp4

board: {{square: 0.0300}}   # side of a square as measured on the print [m]
prior: jelly              # material that a method starts from: jelly, plasticine or sand
density: 1000             # mass over volume [kg/m^3], from a kitchen scale

# center: [0.09, 0.12]    # point on the floor below the object, from the lower left corner of the squares [m]
# scale: 2.0              # metres of the simulator to a metre of the room, for objects of about 10 cm
# held_out: [two]         # falls that are predicted and not learned from
# cameras:
#   left: {{rate: 240}}     # frames a second of slow motion, if the file does not state it
"""


def new_scene(root: Path, name: str, settings: Config) -> Path:
    """Write config/<name>.yaml with a scene of that name.

    Raises:
        InputError: a name that cannot be used, or that exists.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        raise InputError(
            name, "a scene's name must consist of letters, digits and _, and begin with a letter"
        )
    if problem := name_problem(name):
        raise InputError(name, problem)
    if name in settings.scenes or name in settings.experiments:
        raise InputError(name, "a scene or experiment of this name exists", "Choose another name")
    return _written(root / "config" / f"{name}.yaml", SCENE.format(name=name))


def new_capture(root: Path, name: str, settings: Config) -> Path:
    """Write captures/<name>/capture.yaml and create the folders of its files.

    Raises:
        InputError: a name that cannot be used, or that exists.
    """
    if problem := name_problem(name):
        raise InputError(name, problem)
    if {name, scene_name(name, "first")} & settings.scenes.keys():
        raise InputError(name, "a scene of this name exists", "Choose another name")
    folder = root / settings.captures.root / name
    path = _written(folder / "capture.yaml", CAPTURE.format(name=name))
    for kind in ("photos", "stills", "videos"):
        (folder / kind).mkdir(exist_ok=True)
    return path


def _written(path: Path, text: str) -> Path:
    if path.exists():
        raise InputError(path, "the file exists", "Choose another name, or edit it")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path
