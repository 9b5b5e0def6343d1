"""Write the surface that the particles carry as a .blend file, and render its last frame."""

from neuma_lib.data.blender.blend import write_blend
from neuma_lib.geometry.moving_surface import moving_surface, vertex_colours
from neuma_lib.geometry.obstacles import obstacles
from neuma_lib.io.gaussians import load_gaussians
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.mesh import read_mesh
from neuma_lib.io.simulator import with_obstacles
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    path, attributes = read_arrays(inputs.rollout, required=("x", "frames"), only=("x", "frames"))
    mesh = read_mesh(inputs.mesh)
    vertices = moving_surface(mesh, path["x"])
    colours = vertex_colours(mesh, load_gaussians(inputs.gaussians))
    times = path["frames"] * attributes["dt"]
    around = obstacles(with_obstacles(params.obstacles).get("colliders", ()), times)
    write_blend(output.blend, output.picture, vertices, mesh.faces, times, colours, around)
    run.log(f"{vertices.shape[0]} frames of {vertices.shape[1]} vertices")


run_script(main, snakemake)
