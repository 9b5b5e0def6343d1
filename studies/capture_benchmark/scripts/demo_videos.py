"""Render the videos of a drop by all cameras for a demo capture."""

from neuma_lib.io.hdf5 import read_arrays
from studies.capture_benchmark.filming import film, write_video
from studies.capture_benchmark.furniture import rolling_ball
from studies.capture_benchmark.sets import body_of_drop, read_room
from studies.capture_benchmark.settings import DemoCapturesConfig
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    demo = DemoCapturesConfig(**params.demo)
    where, backgrounds = read_room(inputs.room)
    body, frames = body_of_drop(demo, params.name, params.drop, inputs.particles)
    seed = [demo.seed, 2, *f"{params.name} {params.drop}".encode()]
    trouble = demo.objects[params.name].difficulties
    times = read_arrays(inputs.particles, ("time",), ("time",))[0]["time"]
    other = rolling_ball(times) if trouble.bystander else None
    pictures = film(demo, where, body, frames, backgrounds, seed, params.threads, run.progress, other)
    for path, camera in zip(output.videos, sorted(demo.cameras)):
        shown = [picture for picture in pictures[camera] for _ in range(trouble.repeats)]
        write_video(path, shown, trouble.repeats * demo.videos.rate, demo.videos.quality)
    run.log(f"{len(pictures)} videos of {demo.videos.frames} frames")


run_script(main, snakemake)
