"""Bind Gaussians to particles in two passes."""

import torch

from neuma_lib.config.binding import BindingConfig
from neuma_lib.coupling.particle_binding import bind_two_pass
from neuma_lib.io.gaussians import load_gaussians
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.particles import save_binding
from workflow.stage import stage


def main(inputs, binding_file: str, params, run) -> None:
    gaussians = load_gaussians(inputs.gaussians)
    arrays, _ = read_arrays(inputs.particles, required=("x", "vol0"))
    x, vol0 = torch.from_numpy(arrays["x"]), torch.from_numpy(arrays["vol0"])
    settings = BindingConfig(**params.binding)
    matrix, x, added, vol0 = bind_two_pass(gaussians.means, gaussians.covars(), x, vol0, settings)
    save_binding(binding_file, matrix, x, vol0, {"added": added})
    mean = float(matrix.counts.double().mean())
    run.say(
        f"{len(gaussians)} Gaussians to {len(x)} particles, {added} of them added, {mean:.1f} per Gaussian"
    )


if __name__ == "__main__":
    with stage(f"binding {snakemake.wildcards.scene}", snakemake.log[0]) as run:
        main(snakemake.input, snakemake.output.binding, snakemake.params, run)
