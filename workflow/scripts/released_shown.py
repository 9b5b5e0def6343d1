"""Write the video of a released capture as it was filmed, at the size of the report."""

from pathlib import Path

from neuma_lib.capture.released import plate_behind, read_configured, read_shots
from neuma_lib.capture.shown import numbers_of, shown_frames
from neuma_lib.config.capture import ReleasedConfig
from neuma_lib.io.files import listed, read_json
from neuma_lib.io.images import read_transforms, write_transforms
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    shots = read_configured(params.name, ReleasedConfig(**params.settings)).videos
    gains = read_json(inputs.registration)["gains"]
    video = read_transforms(inputs.dynamic)["frames"]
    folder, entries = Path(output.transforms).parent, []
    Path(output.transforms).unlink(missing_ok=True)  # a folder without it is an unfinished one
    for camera, mattes in zip(params.cameras, listed(inputs.mattes), strict=True):
        pictures, masks = zip(*read_shots(shots[camera], params.longest))
        by_number = dict(zip([shot.number for shot in shots[camera]], pictures))
        frames = ((number, by_number[number]) for number in numbers_of(video, camera))
        # Not all files have a picture of the empty scene.
        plate = plate_behind(pictures, masks)
        entries += shown_frames(folder, camera, video, mattes, frames, plate, params.width, gains[camera])
        run.say(f"{camera}: {len(numbers_of(video, camera))} frames")
    write_transforms(output.transforms, {}, entries)


run_script(main, snakemake)
