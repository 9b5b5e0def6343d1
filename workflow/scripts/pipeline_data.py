"""Intermediate results of all stages of one scene, as pictures."""

import numpy as np

from neuma_lib.evaluation.figures import stages
from neuma_lib.evaluation.figures.panels import Panels, save_panels
from neuma_lib.evaluation.figures.pictures import (
    as_bytes,
    cropped,
    evenly,
    magnified,
    milliseconds,
    observed,
    renders,
)
from neuma_lib.evaluation.figures.style import RAMP
from neuma_lib.io.images import load_observation, load_views
from neuma_lib.io.laws import load_law
from neuma_lib.io.mesh import read_mesh
from neuma_lib.io.particles import load_body, load_motion
from neuma_lib.splatting.observation import over_white
from workflow.stage import stage

SHOWN = 5
"""Pictures of every stage."""


def main(inputs, data_file: str, params, run) -> None:
    video = load_observation(inputs.transforms, [params.view])
    body = load_body(inputs.binding, inputs.gaussians, params.scene["density"])
    law = load_law(inputs.prior[0], inputs.adaptor)
    cameras = magnified(video.cameras, params.magnify)
    third = len(video.frames) // 3  # before it, the body only falls
    shown = [third + i for i in evenly(SHOWN, len(video.frames) - third)]
    x, F = (state[shown] for state in load_motion(inputs.rollout))

    seen = observed(video, shown, params.magnify)
    rendered = renders(body, cameras, x, F)
    stressed, strongest = stages.stressed_particles(law, body, x, F, cameras, RAMP)
    start = [
        stages.kernels(body.gaussians, cameras),
        stages.surface(read_mesh(inputs.mesh), cameras),
        stages.plain_particles(body, cameras),
        stages.bound_particles(body, cameras),
    ]
    motion = np.stack([stressed, rendered, seen, stages.difference(rendered, seen)])
    still, motion = cropped([np.stack(start), motion])
    views, _ = load_views(inputs.static, list(range(4)))
    first = np.concatenate([stages.montage(as_bytes(over_white(views)), *still.shape[1:3])[None], still])
    rows = ("I\ninitial\nstate", "II\nsimulation", "III\nrendering", "\nobservation", "\ndifference")
    numbers = {
        "first": ["views at the start", "Gaussian kernels", "surface", "particles", "binding"],
        "heads": [
            f"{params.views} views → kernels, surface, particles; each kernel is bound to the particles inside it",
            "material point method with M = M₀ + ΔM;"
            f" colour: von Mises stress, 0 to {1e-3 * strongest:.0f} kPa",
            "particles carry kernels, kernels are splatted",
            "one video",
            "squared and summed: the loss",
        ],
    }
    columns = tuple(milliseconds([video.frames[i] for i in shown], params.scene["dt"]))
    images = np.concatenate([first[None], motion])
    save_panels(data_file, Panels(images, rows, columns, numbers))
    run.say(f"{images.shape[0]} x {images.shape[1]} pictures: {data_file}")


if __name__ == "__main__":
    with stage("pipeline_data", snakemake.log[0]) as run:
        main(snakemake.input, snakemake.output.data, snakemake.params, run)
