"""Film the prediction beside the observation."""

import numpy as np
import torch

from neuma_lib.device import choose_device
from neuma_lib.evaluation.image_metrics import psnr
from neuma_lib.evaluation.video import side_by_side, write_mp4
from neuma_lib.fitting.carried_field import CarriedField
from neuma_lib.io.files import atomic
from neuma_lib.io.images import load_observation
from neuma_lib.io.particles import load_body, load_motion
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    device = choose_device(params.device)
    observation = load_observation(inputs.transforms, [params.view]).to(torch.float32, device)
    if params.own:
        body = CarriedField.load(inputs.field, params.own, params.density, device)
    else:
        files = (inputs.particles, inputs.binding, inputs.gaussians)
        body = load_body(*files, params.density, params.carrier, params.gaussian_motion)
        body = body.to(torch.float32, device)
    x, F = load_motion(inputs.rollout)
    renderer = body.particle_gs(observation.cameras)
    panels, quality = [], []
    with torch.no_grad():
        for part, images in renderer.batches(x, F):
            pair = [video.cpu().numpy() for video in (observation.colours(part)[:, 0], images[:, 0])]
            quality += [psnr(predicted, seen) for seen, predicted in zip(*pair, strict=True)]
            panels.append(side_by_side(pair, ["observation", "prediction"], magnify=params.magnify))
    video = np.concatenate(panels)
    with atomic(output.video) as partial:
        write_mp4(partial, video, params.frame_rate)
    run.say(f"{len(video)} frames, PSNR {sum(quality) / len(quality):.1f} dB on average")


run_script(main, snakemake)
