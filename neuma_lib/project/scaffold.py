"""New settings files of a project: a scene, a capture."""

import json
import re
import shutil
from pathlib import Path

import yaml

from neuma_lib.config.variants import name_problem
from neuma_lib.errors import InputError
from neuma_lib.io.files import read_json
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
    shape: {shape}
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
      colors: {{{colors}}}
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

# object: {{a.jpg: [268, 115, 775, 625]}}   # a box [px], if other objects are around: neuma select captures/{name}
# bodies: {{clay: {{label: 1}}, gum: {{label: 2}}}}    # several bodies, by their labels in own masks (no density above)
# center: [0.09, 0.12]    # point on the floor below the object, from the lower left corner of the squares [m]
# scale: 2.0              # metres of the simulator to a metre of the room, for objects of about 10 cm
# held_out: [two]         # falls that are predicted and not learned from
# cameras:
#   left: {{rate: 240}}     # frames a second of slow motion, if the file does not state it
"""


BUILT_IN = {
    "shape": "duck                     # ball, duck, pawn, cat, bottle, fish, letter_A ... letter_Z, or a mesh file",
    "colors": 'body: "#f4c534", wing: "#e8a528", beak: "#e8742c", eye: "#2b2522"',
}
OWN_MESH = {
    "shape": "{file}   # y up; of any size and quality: scaled to `size`, closed and evenly meshed",
    "colors": 'body: "#f4c534"',
}


def new_scene(root: Path, name: str, settings: Config, mesh: str | Path | None = None) -> Path:
    """Write config/<name>.yaml with a scene of that name.

    Args:
        mesh: file with the shape of the object; None: a duck. It is copied to meshes/ if it is outside the project.

    Raises:
        InputError: a name that cannot be used, or that exists; a mesh that cannot be read.
    """
    _check_name(name, settings)
    target = root / "config" / f"{name}.yaml"
    if mesh is None:
        return _written(target, SCENE.format(name=name, **BUILT_IN))
    from neuma_lib.io.mesh_files import read_any_mesh

    read_any_mesh(mesh)
    file = Path(mesh).resolve()
    if not file.is_relative_to(root.resolve()):
        copy = root.resolve() / "meshes" / f"{name}{file.suffix.lower()}"
        if copy.exists() or target.exists():
            raise InputError(copy if copy.exists() else target, "the file exists", "Choose another name")
        copy.parent.mkdir(exist_ok=True)
        file = Path(shutil.copyfile(file, copy))
    shape = OWN_MESH["shape"].format(file=json.dumps(file.relative_to(root.resolve()).as_posix()))
    return _written(target, SCENE.format(name=name, **{**OWN_MESH, "shape": shape}))


def next_scene(root: Path, name: str, settings: Config, folder: Path, rank: int = 1) -> Path:
    """Write config/<name>.yaml with an experiment that the page of the next experiment lists.

    A start becomes the scene <name>, in whose video the same law is identified as in that of the existing scene. A
    second camera changes the views of the existing scene.

    Args:
        folder: results of the scene, with next.json.
        rank: of the experiment, from 1.

    Raises:
        InputError: there is no such experiment, the scene is not rendered, or a name that cannot be used.
    """
    known = folder.name
    if not (folder / "next.json").is_file():
        problem = "does not exist, so no experiment has been chosen"
        raise InputError(folder / "next.json", problem, f"Run `neuma next {folder}` first")
    _check_name(name, settings)
    candidates = read_json(folder / "next.json")["candidates"]
    if not 1 <= rank <= len(candidates):
        raise InputError("--rank", f"{rank} must be from 1 to {len(candidates)}")
    # Copied, because YAML knows no subclasses of dict.
    scene, chosen = settings.scene(known), json.loads(json.dumps(candidates[rank - 1]))
    if not scene.has_truth or scene.images.dynamic is not None:
        problem = "is not rendered, so that the experiment has to be done and filmed"
        raise InputError(known, problem, "Add its video to the capture, or as a scene to `videos`")
    if chosen["kind"] == "camera":
        view = chosen["settings"]["view"]
        views = sorted({*settings.identify.views, view})
        count = max(settings.dataset.dynamic.views, view + 1)
        content = {"identify": {"views": views}, "dataset": {"dynamic": {"views": count}}}
    else:
        own = {
            "like": known,
            "frames": None,
            **({"clamps": []} if scene.clamps else {}),
            **chosen["settings"],
        }
        if "colliders" in own:
            own["colliders"] = [*(each.arguments() for each in scene.colliders), *own["colliders"]]
        content = {"scenes": {name: own, known: {"videos": [*scene.videos, name]}}}
    title = f"# Experiment {rank} of {folder.name}/next.md, on top of the settings of {known}.\n"
    return _written(
        root / "config" / f"{name}.yaml",
        f"# yaml-language-server: $schema=schema.json\n{title}{yaml.safe_dump(content, sort_keys=False)}",
    )


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


def _check_name(name: str, settings: Config) -> None:
    """Raises InputError if a name cannot be that of a new scene."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name):
        problem = "a scene's name must consist of letters, digits and _, and begin with a letter"
        raise InputError(name, problem)
    if problem := name_problem(name):
        raise InputError(name, problem)
    if name in settings.scenes or name in settings.experiments:
        raise InputError(name, "a scene or experiment of this name exists", "Choose another name")


def _written(path: Path, text: str) -> Path:
    if path.exists():
        raise InputError(path, "the file exists", "Choose another name, or edit it")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path
