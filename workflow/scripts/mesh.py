"""Reconstruct a watertight surface from Gaussians and views."""

from neuma_lib.config.geometry import SurfaceConfig
from neuma_lib.geometry.surface import reconstruct
from neuma_lib.io.gaussians import load_gaussians
from neuma_lib.io.images import load_views
from neuma_lib.io.mesh import write_mesh
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    images, cameras = load_views(inputs.transforms)
    mesh = reconstruct(load_gaussians(inputs.gaussians), cameras, images, SurfaceConfig(**params.surface))
    write_mesh(output.mesh, mesh.vertices, mesh.faces)
    run.say(f"{len(mesh.faces)} faces, watertight: {mesh.is_watertight}, volume {1e3 * mesh.volume:.3f} l")


run_script(main, snakemake)
