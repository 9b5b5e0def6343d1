"""Film a prediction from the front, as mp4 and GIF."""

import numpy as np

from neuma_lib.evaluation.plotting.rendering import frontal, renders, seen_around
from neuma_lib.evaluation.video import write_gif, write_mp4
from neuma_lib.io.files import atomic
from neuma_lib.io.particles import load_motion, load_reconstruction
from workflow.stage import run_script

SQUARE = 2  # codecs want sides of a whole number of these [px]


def main(inputs, output, params, run) -> None:
    files = (inputs.particles, inputs.binding, inputs.gaussians)
    body = load_reconstruction(*files, 1.0, params.particle_source, params.gaussian_motion)
    x, F = load_motion(inputs.rollout)
    seen = seen_around(body, x, F)
    wide, high = np.ptp(seen, axis=0)[:2]
    height = params.size * float(np.clip(high / wide, 0.5, 2.0))
    width, height = (SQUARE * max(1, round(side / SQUARE)) for side in (params.size, height))
    video = renders(body, frontal(seen, width, height), x, F)
    for file, write in ((output.film, write_mp4), (output.gif, write_gif)):
        with atomic(file) as partial:
            write(partial, video, params.frame_rate)
    run.log(f"{len(video)} frames of {width}x{height} px")


run_script(main, snakemake)
