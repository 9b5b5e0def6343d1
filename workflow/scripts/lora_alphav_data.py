"""Motions under the prior plus w times the adaptor."""

import numpy as np
import torch

from neuma_lib.device import choose_device
from neuma_lib.evaluation.figures.panels import Panels, save_panels
from neuma_lib.evaluation.figures.pictures import (
    cropped,
    evenly,
    magnified,
    mean_height,
    milliseconds,
    monotone_frames,
    observed,
    renders,
)
from neuma_lib.evaluation.motion import predict
from neuma_lib.io.files import read_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.images import load_observation
from neuma_lib.io.laws import load_law
from neuma_lib.io.particles import load_body
from neuma_lib.sim.model import MPMModel
from workflow.stage import stage


def main(inputs, data_file: str, params, run) -> None:
    device = choose_device(params.device)
    blocks, rows, scenes = [], [], {}
    inside = [k for k, weight in enumerate(params.weights) if 0 <= weight <= 1]
    for k, (scene, setting) in enumerate(params.scenes.items()):
        model = MPMModel(**setting["simulation"])
        video = load_observation(inputs.transforms[k], [params.view])
        body = load_body(inputs.binding[k], inputs.gaussians[k], setting["density"]).to(torch.float32, device)
        law = load_law(inputs.prior[k], inputs.adaptor[k]).to(device)
        v0 = torch.tensor(read_json(inputs.velocity[k])["v0"], dtype=torch.float32, device=device)
        truth, _ = read_arrays(inputs.truth[k], required=("x", "mass"), only=("x", "mass"))
        shown = evenly(params.shown, len(video.frames))[1:]  # the start is the same for all
        cameras = magnified(video.cameras, params.magnify).to(device)
        columns, heights = [], []
        for weight in params.weights:
            law.set_adaptor_weight(weight)
            path, diverged = predict(model, law, body, v0, video.frames)
            columns.append(renders(body, cameras, path.x[shown], path.F[shown]))
            heights.append(mean_height(path.x.cpu(), body.mass.cpu()))
            run.detail(f"{scene}: w = {weight:g}" + (f" diverged at step {diverged}" if diverged else ""))
        monotone, parted = monotone_frames([heights[k] for k in inside])
        run.say(
            f"{scene}: between 0 and 1, height monotone in w in {monotone} of {parted} frames after contact"
        )
        columns.append(observed(video, shown, params.magnify))
        blocks.append(np.stack(columns, axis=1))
        rows += milliseconds([video.frames[i] for i in shown], model.dt)
        scenes[scene] = {
            "rows": len(shown),
            "time": [model.dt * step for step in video.frames],
            "heights": heights,
            "truth": mean_height(truth["x"], truth["mass"]),
        }
    titles = [f"$w$ = {weight:g}" for weight in params.weights] + ["observed"]
    numbers = {"weights": params.weights, "scenes": scenes}
    images = np.concatenate(cropped(blocks, guides=[block[:, [*inside, -1]] for block in blocks]))
    save_panels(data_file, Panels(images, tuple(rows), tuple(titles), numbers))
    run.say(f"{len(params.weights)} weights on {len(scenes)} scenes: {data_file}")


if __name__ == "__main__":
    with stage("lora_alphav_data", snakemake.log[0]) as run:
        main(snakemake.input, snakemake.output.data, snakemake.params, run)
