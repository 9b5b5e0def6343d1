"""Reconstruct a watertight surface from Gaussians and views; that of a photographed body is repaired and remeshed."""

from neuma_lib.config.geometry import SurfaceConfig
from neuma_lib.config.photographs import PhotographsConfig
from neuma_lib.geometry.surface import photographed, reconstruct
from neuma_lib.io.gaussians import load_gaussians
from neuma_lib.io.mesh import write_mesh
from neuma_lib.io.photographs import load_static
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    views = load_static(inputs.transforms, PhotographsConfig(**params.photographs))
    surface = SurfaceConfig(**params.surface)
    mesh = reconstruct(load_gaussians(inputs.gaussians), views.cameras, views.images, surface, views.floor)
    if views.photographs:
        mesh = photographed(mesh, views.photographs.edge, views.floor)
    write_mesh(output.mesh, mesh.vertices, mesh.faces)
    run.log(f"{len(mesh.faces)} faces, watertight: {mesh.is_watertight}, volume {1e3 * mesh.volume:.3f} l")


run_script(main, snakemake)
