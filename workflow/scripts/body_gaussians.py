"""The Gaussians of one of several bodies, by the labels of the views at t = 0."""

from pathlib import Path

import torch

from neuma_lib.errors import InputError
from neuma_lib.io.gaussians import load_gaussians, save_gaussians
from neuma_lib.io.images import read_image_set, read_labels
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.labels import bodies_of
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    name = Path(output.gaussians).stem
    if name not in params.bodies:
        raise InputError(output.gaussians, f"the bodies of the scene are {', '.join(params.bodies)}")
    gaussians, views = load_gaussians(inputs.gaussians), read_image_set(inputs.transforms)
    cameras = Cameras(
        torch.from_numpy(views.viewmats).float(),
        torch.from_numpy(views.Ks).float(),
        views.width,
        views.height,
    )
    labels = torch.from_numpy(read_labels(inputs.transforms)).long()
    bodies = bodies_of(gaussians, cameras, labels, len(params.bodies))
    own = bodies == params.bodies.index(name)
    save_gaussians(output.gaussians, gaussians[own])
    run.log(f"{int(own.sum())} of {len(own)} Gaussians")


run_script(main, snakemake)
