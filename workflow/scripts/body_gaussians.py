"""The Gaussians of one of several bodies, by the labels of the views at t = 0."""

import torch

from neuma_lib.io.gaussians import load_gaussians, save_gaussians
from neuma_lib.io.images import load_views, read_labels
from neuma_lib.splatting.labels import bodies_of
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    gaussians, (_, cameras) = load_gaussians(inputs.gaussians), load_views(inputs.transforms)
    labels = torch.from_numpy(read_labels(inputs.transforms)).long()
    own = bodies_of(gaussians, cameras, labels, len(params.bodies)) == params.bodies.index(params.body)
    save_gaussians(output.gaussians, gaussians[own])
    run.log(f"{int(own.sum())} of {len(own)} Gaussians")


run_script(main, snakemake)
