"""Write the Gaussians of every frame as PLY files that splat viewers open."""

from pathlib import Path

import torch

from neuma_lib.coupling.frames import gaussians_at
from neuma_lib.io.compressed_splats import save_compressed
from neuma_lib.io.gaussians import save_gaussians
from neuma_lib.io.particles import load_motion, load_reconstruction
from neuma_lib.splatting.culling import morton_order
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    files = (inputs.particles, inputs.binding, inputs.gaussians)
    body = load_reconstruction(*files, 1.0, params.particle_source, params.gaussian_motion)
    x, F = load_motion(inputs.rollout)
    order = morton_order(body.gaussians.means.double().numpy())  # of all frames: a Gaussian keeps its place
    for k in range(len(x)):
        with torch.no_grad():
            gaussians = gaussians_at(body, x[k].to(body.x0), F[k].to(body.x0), params.rotate_harmonics)
        if params.compressed:
            save_compressed(Path(output.frames, f"{k:04d}.compressed.ply"), gaussians, order)
        else:
            save_gaussians(Path(output.frames, f"{k:04d}.ply"), gaussians)
        run.progress(k + 1, len(x))
    run.log(f"{len(x)} frames of {len(body.gaussians)} Gaussians")


run_script(main, snakemake)
