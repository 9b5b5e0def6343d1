"""Film the prediction next to the observation."""

import numpy as np
import torch

from neuma_lib.coupling.filmed import Filmed
from neuma_lib.device import choose_device
from neuma_lib.errors import InputError
from neuma_lib.evaluation.image_metrics import psnr
from neuma_lib.evaluation.video import side_by_side, write_mp4
from neuma_lib.fitting.frame_batches import frame_batches
from neuma_lib.io.files import atomic
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import load_videos
from neuma_lib.io.particles import load_motion
from neuma_lib.splatting.observation import rendered_steps
from workflow.motion import Prediction
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    device = choose_device(params.device)
    prediction = Prediction(inputs, params.method)
    body = prediction.body(params.density, params.particle_source, params.gaussian_motion, device)
    x, F = load_motion(inputs.rollout)
    steps = read_arrays(inputs.rollout, required=("frames",), only=("frames",))[0]["frames"].tolist()
    panels, quality = {}, []
    for observation in load_videos(inputs.transforms, [params.view], **params.exposure):
        observation = observation.to(torch.float32, device)
        if not set(rendered_steps([observation])) <= set(steps):
            raise InputError(
                f"{inputs.rollout} has other frames than {inputs.transforms}: run evaluation again"
            )
        filmed = Filmed(body.particle_gs(observation.cameras), observation, steps)
        for part in frame_batches(len(observation.frames), filmed.batch):
            with torch.no_grad():
                images = filmed(*(filmed.states(state, part).to(device) for state in (x, F)))
            pair = [video.cpu().numpy() for video in (observation.colours(part)[:, 0], images[:, 0])]
            quality += [psnr(predicted, seen) for seen, predicted in zip(*pair, strict=True)]
            panel = side_by_side(pair, ["observation", "prediction"], magnify=params.magnify)
            panels.update(zip(observation.frames[part], panel, strict=True))
    video = np.stack([panels[step] for step in sorted(panels)])
    with atomic(output.video) as partial:
        write_mp4(partial, video, params.frame_rate)
    run.log(f"{len(video)} frames, PSNR {sum(quality) / len(quality):.1f} dB on average")


run_script(main, snakemake)
