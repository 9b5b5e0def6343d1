"""The picture of the README: what was seen, what the prior predicts, what the learned law predicts."""

import numpy as np
import torch
from PIL import Image

from neuma_lib.artifacts import load_body, load_observation
from neuma_lib.evaluation.video import film_strips
from neuma_lib.io import atomic, read_arrays
from neuma_lib.progress import stage


def frames(body, observation, rollout: str) -> np.ndarray:
    arrays, _ = read_arrays(rollout, required=("x", "F"))
    renderer = body.particle_gs(observation.cameras)
    with torch.no_grad():
        parts = [
            images[:, 0]
            for _, images in renderer.batches(
                torch.from_numpy(arrays["x"]), torch.from_numpy(arrays["F"]), size=8
            )
        ]
    return torch.cat(parts).numpy()


def main(inputs, picture: str, params, run) -> None:
    columns = []
    for k, scene in enumerate(params.scenes):
        observation = load_observation(inputs.transforms[k], [params.view])
        body = load_body(inputs.binding[k], inputs.gaussians[k], params.density[k])
        rows = {
            "observed": observation.images[:, 0].numpy(),
            "prior": frames(body, observation, inputs.prior[k]),
            "NeuMA": frames(body, observation, inputs.learned[k]),
        }
        columns.append((scene, rows))
    image = film_strips(columns, count=params.shown, magnify=2)
    with atomic(picture) as partial:
        Image.fromarray(image).save(partial, format="PNG")
    run.say(f"{len(params.scenes)} scenes: {picture}")


if __name__ == "__main__":
    with stage("overview", snakemake.log[0]) as run:
        main(snakemake.input, snakemake.output.picture, snakemake.params, run)
