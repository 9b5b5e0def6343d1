"""Find the surface of a splat in renders of it, and repair it."""

from neuma_lib.config.geometry import SurfaceConfig
from neuma_lib.geometry.repair import has_meshlab, repaired
from neuma_lib.geometry.splat_surface import splat_surface, views_around
from neuma_lib.io.gaussians import load_gaussians
from neuma_lib.io.mesh import write_mesh
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    gaussians = load_gaussians(inputs.gaussians)
    cameras = views_around(gaussians, params.views, params.pixels)
    mesh = splat_surface(gaussians, cameras, SurfaceConfig(**params.surface))
    if params.edge and not has_meshlab():
        run.log("the surface is not repaired, as pymeshlab is missing (`make capture` installs it)")
    elif params.edge:
        mesh = repaired(mesh, params.edge * float(mesh.extents.max()), "surface")
    write_mesh(output.mesh, mesh.vertices, mesh.faces)
    run.log(f"{len(mesh.faces)} faces, watertight: {mesh.is_watertight}, volume {1e3 * mesh.volume:.3f} l")


run_script(main, snakemake)
