"""Reconstruct a watertight surface from Gaussians and views; that of a photographed body is repaired and remeshed."""

from pathlib import Path

from neuma_lib.capture.gates import check_volume, draw_body
from neuma_lib.capture.pictures import evidence
from neuma_lib.config.geometry import SurfaceConfig
from neuma_lib.config.photographs import PhotographsConfig
from neuma_lib.geometry.surface import photographed, reconstruct
from neuma_lib.geometry.visual_hull import visual_hull
from neuma_lib.io.gaussians import load_gaussians
from neuma_lib.io.mesh import write_mesh
from neuma_lib.io.photographs import load_static
from neuma_lib.splatting.labels import without_others
from workflow.stage import run_script

_HULL_RESOLUTION = 48  # voxels along the longest side of the visual hull, to compare volumes


def main(inputs, output, params, run) -> None:
    views = load_static(inputs.transforms, PhotographsConfig(**params.photographs))
    surface = SurfaceConfig(**params.surface)
    gaussians, images = load_gaussians(inputs.gaussians), views.images
    if views.hidden is not None:
        pairs = zip(images, views.hidden, strict=True)
        images = [
            without_others(gaussians, views.cameras[k], image[None], hidden[None])[0]
            for k, (image, hidden) in enumerate(pairs)
        ]
    mesh = reconstruct(gaussians, views.cameras, images, surface, views.floor)
    if views.photographs:
        mesh = photographed(mesh, views.photographs.edge, views.floor)
        masks, name = [image[..., 3] for image in images], Path(inputs.transforms).parent.parent.name
        hull = visual_hull(masks, views.cameras, _HULL_RESOLUTION, views.floor)
        inside = (hull.origin + (hull.occupied.nonzero() + 0.5) * hull.voxel).cpu().numpy()
        volume = len(inside) * hull.voxel**3

        def draw(path: Path) -> None:
            draw_body(path, {"visual hull": inside, "surface": mesh.vertices}, views.floor, name)

        with evidence(output.mesh, draw):
            check_volume(float(mesh.volume), volume, mesh.is_watertight, name)
    write_mesh(output.mesh, mesh.vertices, mesh.faces)
    run.log(f"{len(mesh.faces)} faces, watertight: {mesh.is_watertight}, volume {1e3 * mesh.volume:.3f} l")


run_script(main, snakemake)
