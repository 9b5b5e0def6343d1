"""Write the original frames of a take at the size of the report."""

from pathlib import Path

import numpy as np

from neuma_lib.capture.calibration.lens import read_lens
from neuma_lib.capture.frames import read_frames, read_timeline
from neuma_lib.capture.masks.mattes import room_frames
from neuma_lib.capture.pictures import read_picture, undistorted
from neuma_lib.capture.report.display_video import display_frames, numbers_of
from neuma_lib.io.files import listed, read_json
from neuma_lib.io.images import read_transforms, write_transforms
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    registrations = [read_json(file) for file in listed(inputs.registration)]  # of each body
    lenses = read_json(inputs.report)["lenses"]
    video = read_transforms(inputs.dynamic)["frames"]
    folder, entries = Path(output.transforms).parent, []
    Path(output.transforms).unlink(missing_ok=True)  # a folder without it is incomplete
    files = zip(params.cameras, listed(inputs.videos), listed(inputs.mattes), params.rates, strict=True)
    for camera, file, mattes, rate in files:
        lens = read_lens(lenses[camera], inputs.report)
        (still,) = room_frames(inputs.room, camera)
        background = read_picture(Path(inputs.room).parent / still["file_path"])
        frames = (
            (frame.number, undistorted(frame.pixels, lens, params.longest))
            for frame in read_frames(file, read_timeline(file, rate), numbers_of(video, camera))
        )
        gain = np.mean([each["gains"][camera] for each in registrations], axis=0)
        new = display_frames(folder, camera, video, mattes, frames, background, params.width, gain.tolist())
        entries += new
        run.log(f"{camera}: {len(new)} frames")
    write_transforms(output.transforms, {}, entries)


run_script(main, snakemake)
