"""Find the family and the constants of the material in the video."""

import torch

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.device import choose_device
from neuma_lib.fitting.identify import identify
from neuma_lib.fitting.throw import Throw
from neuma_lib.io.files import read_json, write_json
from neuma_lib.io.images import load_observation
from neuma_lib.io.particles import load_body
from neuma_lib.sim.model import MPMModel
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    settings = IdentifyConfig(**params.identify)
    device = choose_device(params.device)
    files = (inputs.particles, inputs.binding, inputs.gaussians)
    body = load_body(*files, params.density, gaussian_motion=settings.gaussian_motion)
    body = body.to(torch.float32, device)
    video = load_observation(inputs.transforms, settings.views).to(torch.float32, device)
    throw = Throw.of(read_json(inputs.velocity))
    model = MPMModel(**params.simulation)
    found = identify(model, throw, body, video, settings, params.stock, run.progress, run.say)
    write_json(output.identified, found.as_dict())
    run.say(found.summary())


run_script(main, snakemake)
