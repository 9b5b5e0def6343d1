"""Film methods next to the video, as mp4 and as gif."""

import torch

from neuma_lib.device import choose_device
from neuma_lib.evaluation.plotting.rendering import magnified, observed, renders
from neuma_lib.evaluation.video import side_by_side, write_gif, write_mp4
from neuma_lib.io.files import atomic
from neuma_lib.io.images import load_observation
from neuma_lib.io.particles import load_motion, load_reconstruction
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    device = choose_device(params.device)
    video = load_observation(inputs.transforms, [params.view])
    cameras = magnified(video.cameras, params.magnify).to(device)
    panels = [observed(video, range(len(video.frames)), params.magnify)]
    for file, motion in zip(inputs.rollouts, params.motions, strict=True):
        body = load_reconstruction(
            inputs.particles, inputs.binding, inputs.gaussians, params.density, gaussian_motion=motion
        )
        x, F = load_motion(file)
        panels.append(renders(body.to(torch.float32, device), cameras, x, F))
    film = side_by_side([panel / 255 for panel in panels], ["video", *params.titles])
    with atomic(output.mp4) as partial:
        write_mp4(partial, film, params.frame_rate)
    with atomic(output.gif) as partial:
        write_gif(partial, film, params.frame_rate)
    run.log(f"{len(film)} frames: {output.mp4}, {output.gif}")


run_script(main, snakemake)
