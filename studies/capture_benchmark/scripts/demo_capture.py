"""Write pictures of the empty scene and capture.yaml of a demo capture, and its ground truth outside of it."""

import numpy as np
import yaml
from PIL import Image

from neuma_lib.io.files import atomic, read_json, write_json, write_text
from studies.capture_benchmark.filming import developed
from studies.capture_benchmark.furniture import marks
from studies.capture_benchmark.planned import capture_settings, photograph_files
from studies.capture_benchmark.sets import read_room
from studies.capture_benchmark.settings import DemoCapturesConfig
from studies.capture_benchmark.truth import truth_of
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    demo = DemoCapturesConfig(**params.demo)
    _, backgrounds = read_room(inputs.room)
    rng = np.random.default_rng([demo.seed, 3])
    for path, camera in zip(output.stills, sorted(demo.cameras)):
        with atomic(path) as partial:
            Image.fromarray(developed(backgrounds[camera], demo.videos.noise, rng)).save(partial, "PNG")
    write_json(output.truth, truth_of(demo, params.name, read_json(inputs.photographs)))
    settings = capture_settings(demo, params.name) | marks(demo, params.name, photograph_files(demo))
    write_text(output.settings, yaml.safe_dump(settings, sort_keys=False))
    run.log(f"{len(backgrounds)} stills, capture.yaml and truth.json")


run_script(main, snakemake)
