"""Render the videos of a drop by all cameras for a demo capture."""

from studies.capture_benchmark.filming import film, write_video
from studies.capture_benchmark.sets import body_of_drop, read_room
from studies.capture_benchmark.settings import DemoCapturesConfig
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    demo = DemoCapturesConfig(**params.demo)
    where, backgrounds = read_room(inputs.room)
    body, frames = body_of_drop(demo, params.name, params.drop, inputs.particles)
    seed = [demo.seed, 2, *f"{params.name} {params.drop}".encode()]
    pictures = film(demo, where, body, frames, backgrounds, seed, params.threads, run.progress)
    for path, camera in zip(output.videos, sorted(demo.cameras)):
        write_video(path, pictures[camera], demo.videos.rate, demo.videos.quality)
    run.log(f"{len(pictures)} videos of {demo.videos.frames} frames")


run_script(main, snakemake)
