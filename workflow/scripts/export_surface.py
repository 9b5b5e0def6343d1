"""Write the surface that the particles carry as glTF or USD."""

from pathlib import Path

from neuma_lib.geometry.moving_surface import moving_surface, vertex_colours
from neuma_lib.geometry.obstacles import obstacles
from neuma_lib.io.files import read_json
from neuma_lib.io.gaussians import load_gaussians
from neuma_lib.io.gltf import write_glb
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.mesh import read_mesh
from neuma_lib.io.simulator import with_obstacles
from neuma_lib.io.usd import write_usd
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    path, attributes = read_arrays(inputs.rollout, required=("x", "frames"), only=("x", "frames"))
    mesh = read_mesh(inputs.mesh)
    vertices = moving_surface(mesh, path["x"])
    colours = vertex_colours(mesh, load_gaussians(inputs.gaussians))
    times = path["frames"] * attributes["dt"]
    around = obstacles(with_obstacles(params.obstacles).get("colliders", ()), times)
    bodies = read_json(inputs.velocity).get("bodies", ())
    names = [(body.get("name", body["scene"]), body["vertices"]) for body in bodies]
    write = write_glb if Path(output.surface).suffix == ".glb" else write_usd
    write(output.surface, vertices, mesh.faces, times, colours, around, names)
    run.log(f"{vertices.shape[0]} frames of {vertices.shape[1]} vertices")


run_script(main, snakemake)
