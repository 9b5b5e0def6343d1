"""Frames of the video, and renders of all methods at the same times."""

import numpy as np

from neuma_lib.evaluation.figures.panels import Panels, save_panels
from neuma_lib.evaluation.figures.pictures import cropped, evenly, magnified, milliseconds, observed, renders
from neuma_lib.io.images import load_observation
from neuma_lib.io.particles import load_body, load_motion
from workflow.stage import stage


def main(inputs, data_file: str, params, run) -> None:
    blocks, times, groups = [], [], []
    rollouts = iter(inputs.rollouts)
    for k, (scene, setting) in enumerate(params.scenes.items()):
        video = load_observation(inputs.transforms[k], [params.view])
        body = load_body(inputs.binding[k], inputs.gaussians[k], setting["density"])
        shown = evenly(params.shown, len(video.frames))
        cameras = magnified(video.cameras, params.magnify)
        rows = [observed(video, shown, params.magnify)]
        for _ in params.titles:
            rows.append(renders(body, cameras, *(state[shown] for state in load_motion(next(rollouts)))))
        blocks.append(np.stack(rows))
        times += milliseconds([video.frames[i] for i in shown], setting["dt"])
        groups.append((scene, len(shown)))
    images = np.concatenate(cropped(blocks), axis=1)
    rows = ("Observation", *params.titles.values())
    save_panels(data_file, Panels(images, rows, tuple(times), {"groups": groups}))
    run.say(f"{images.shape[0]} x {images.shape[1]} pictures: {data_file}")


if __name__ == "__main__":
    with stage("main_res_data", snakemake.log[0]) as run:
        main(snakemake.input, snakemake.output.data, snakemake.params, run)
