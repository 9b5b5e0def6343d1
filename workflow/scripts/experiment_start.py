"""Put the bodies of an experiment together: solids filled with particles, or reconstructed objects."""

from collections.abc import Iterator

import numpy as np
import torch
import trimesh

from neuma_lib.config.blender import AppearanceConfig
from neuma_lib.coupling.bodies import coloured_solid, join
from neuma_lib.data.blender.appearance import colors_at
from neuma_lib.geometry.shapes import place, to_nominal
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.files import listed, read_json, write_json
from neuma_lib.io.gaussians import save_gaussians
from neuma_lib.io.mesh import read_mesh, write_mesh
from neuma_lib.io.particles import INITIAL_MOTION, load_reconstruction, save_binding, save_particles
from workflow.inputs import solid
from workflow.stage import run_script


def look_of(entry: dict, mesh: trimesh.Trimesh) -> AppearanceConfig:
    """The look of the body's scene, as far as its own shape has the parts that are coloured there."""
    known = to_nominal(mesh, mesh.vertices)[0].part_names
    colors = {name: value for name, value in entry["appearance"]["colors"].items() if name in known}
    return AppearanceConfig(**{**entry["appearance"], "colors": colors})


def main(inputs, output, params, run) -> None:
    names = ("particles", "binding", "gaussians", "mesh", "velocity")
    reconstructed: Iterator = zip(*(getattr(inputs, name) for name in names), strict=True)
    solids = iter(listed(inputs.meshes))
    bodies, meshes, starts = [], [], []
    for entry in params.bodies:
        if entry["reconstructed"]:
            *parts, surface, velocity = next(reconstructed)
            body, mesh, start = load_reconstruction(*parts, 1.0), read_mesh(surface), read_json(velocity)
        else:
            mesh = place(solid(entry["shape"], solids), entry["size"], entry["height"], entry["center"])
            x0 = sample_volume(mesh, params.particles, seed=params.seed, method=params.sampling)
            colors = torch.from_numpy(colors_at(mesh, x0, look_of(entry, mesh)))
            body = coloured_solid(mesh, torch.as_tensor(x0, dtype=torch.float32), 1.0, colors)
            start = {"v0": entry["velocity"], "angular_velocity": entry["spin"], "centre": None}
        bodies.append(body)
        meshes.append(mesh)
        motion = {key: start[key] for key in INITIAL_MOTION}
        counts = {"particles": len(body.x0), "gaussians": len(body.gaussians), "vertices": len(mesh.vertices)}
        named = {"name": entry["name"]} if "name" in entry else {}
        starts.append({**named, "scene": entry["scene"], **motion, **counts})
    together, surface = join(bodies), trimesh.util.concatenate(meshes)
    save_gaussians(output.gaussians, together.gaussians)
    save_particles(output.particles, together.x0, together.vol0, {})
    save_binding(output.binding, together.binding)
    write_mesh(output.mesh, np.asarray(surface.vertices), np.asarray(surface.faces))
    write_json(output.velocity, {"bodies": starts, "separate": params.separate})
    run.log(f"{len(bodies)} bodies, {len(together.x0)} particles, {len(together.gaussians)} Gaussians")


run_script(main, snakemake)
