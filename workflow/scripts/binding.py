"""Bind Gaussians to particles: in two passes with own particles for Gaussians, or to the nearest sampled particles."""

from neuma_lib.config.binding import BindingConfig
from neuma_lib.coupling.nearest_binding import bind_nearest
from neuma_lib.coupling.particle_binding import bind_two_pass
from neuma_lib.io.gaussians import load_gaussians
from neuma_lib.io.particles import load_particles, save_binding, save_particles
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    gaussians = load_gaussians(inputs.gaussians)
    x, vol0, _ = load_particles(inputs.sampled)
    settings, added = BindingConfig(**params.binding), 0
    if params.own_particles:
        matrix, x, added, vol0 = bind_two_pass(gaussians.means, gaussians.covars(), x, vol0, settings)
    else:
        matrix = bind_nearest(gaussians.means, gaussians.covars(), x, settings)
    save_binding(output.binding, matrix)
    save_particles(output.particles, x, vol0, {"added": added})
    mean = float(matrix.counts.double().mean())
    run.log(
        f"{len(gaussians)} Gaussians to {len(x)} particles, {added} of them added, {mean:.1f} per Gaussian"
    )


run_script(main, snakemake)
