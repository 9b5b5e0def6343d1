"""Repair a mesh file of the user to one solid body."""

import numpy as np

from neuma_lib.geometry.solid_body import solid_body
from neuma_lib.io.mesh import write_mesh
from neuma_lib.io.mesh_files import read_any_mesh
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    mesh = read_any_mesh(inputs.mesh)
    run.log(f"{inputs.mesh}: {len(mesh.faces)} faces, longest side {mesh.extents.max():.4g} in its unit")
    body, done = solid_body(mesh, inputs.mesh)
    for step in done:
        run.log(step)
    write_mesh(output.mesh, np.asarray(body.vertices), np.asarray(body.faces))


run_script(main, snakemake)
