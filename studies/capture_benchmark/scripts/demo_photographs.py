"""Render photographs of an object at rest for a demo capture, and write their true cameras."""

from pathlib import Path

from neuma_lib.io.files import write_json
from studies.capture_benchmark.filming import photograph, write_jpeg
from studies.capture_benchmark.sets import body_at_rest, read_room
from studies.capture_benchmark.settings import DemoCapturesConfig
from studies.capture_benchmark.stage import photographers
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    demo = DemoCapturesConfig(**params.demo)
    where, _ = read_room(inputs.room)
    eyes = photographers(demo, params.name)
    taken = photograph(demo, where, body_at_rest(demo, params.name), eyes, params.threads, run.progress)
    truth = {}
    for path, eye, (pixels, light) in zip(output.photographs, eyes, taken):
        write_jpeg(path, pixels, demo.photographs.quality)
        truth[Path(path).name] = {**eye.plain(), "light": light}
    write_json(output.truth, truth)
    run.log(f"{len(truth)} photographs")


run_script(main, snakemake)
