"""Find the families and constants of the materials of several bodies in one video, and their friction."""

import torch

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.device import choose_device
from neuma_lib.fitting.identify_bodies import identify_bodies
from neuma_lib.io.files import listed, read_json, write_json
from neuma_lib.io.images import load_videos
from neuma_lib.io.particles import load_reconstruction
from neuma_lib.io.simulator import simulator
from neuma_lib.threads import use_threads
from workflow.motion import BODY
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    use_threads(snakemake.threads)
    settings, device = IdentifyConfig(**params.identify), choose_device(params.device)
    files = zip(*(listed(inputs[name]) for name in BODY), params.densities, strict=True)
    bodies = [
        load_reconstruction(*body, gaussian_motion=settings.gaussian_motion).to(torch.float32, device)
        for body in files
    ]
    motions = [InitialMotion.of(read_json(file)) for file in listed(inputs.velocity)]
    videos = load_videos(inputs.transforms, settings.views, **params.exposure)
    identification = identify_bodies(
        simulator(params.simulation),
        dict(zip(params.bodies, motions, strict=True)),
        bodies,
        [video.to(torch.float32, device) for video in videos],
        settings,
        params.given,
        log=run.log,
    )
    write_json(output.identified, identification.as_dict())
    for line in identification.summary():
        run.log(line)


run_script(main, snakemake)
