"""Write the original frames of a released capture at the size of the report."""

from pathlib import Path

from neuma_lib.capture.released import background_behind, read_configured, read_shots
from neuma_lib.capture.report.display_video import display_frames, numbers_of
from neuma_lib.config.capture import ReleasedConfig
from neuma_lib.io.files import listed, read_json
from neuma_lib.io.images import read_transforms, write_transforms
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    shots = read_configured(params.name, ReleasedConfig(**params.settings)).videos
    gains = read_json(inputs.registration)["gains"]
    video = read_transforms(inputs.dynamic)["frames"]
    folder, entries = Path(output.transforms).parent, []
    Path(output.transforms).unlink(missing_ok=True)  # a folder without it is incomplete
    for camera, mattes in zip(params.cameras, listed(inputs.mattes), strict=True):
        pictures, masks = zip(*read_shots(shots[camera], params.longest))
        by_number = dict(zip([shot.number for shot in shots[camera]], pictures))
        frames = ((number, by_number[number]) for number in numbers_of(video, camera))
        # There is no picture of the empty scene.
        background = background_behind(pictures, masks)
        entries += display_frames(
            folder, camera, video, mattes, frames, background, params.width, gains[camera]
        )
        run.log(f"{camera}: {len(numbers_of(video, camera))} frames")
    write_transforms(output.transforms, {}, entries)


run_script(main, snakemake)
