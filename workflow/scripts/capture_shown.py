"""Write a throw's video as it was filmed, at the size of the report: frames, mattes, the empty scene."""

from pathlib import Path

import numpy as np
from PIL import Image

from neuma_lib.capture.clock import reduced, reduced_intrinsics
from neuma_lib.capture.frames import read_frames, read_timeline
from neuma_lib.capture.lens import read_lens
from neuma_lib.capture.masks import match_exposure
from neuma_lib.capture.mattes import read_pixels, room_frames
from neuma_lib.capture.pictures import undistorted
from neuma_lib.errors import InputError
from neuma_lib.io.files import atomic, read_json
from neuma_lib.io.images import open_image, read_transforms, write_transforms
from workflow.inputs import listed
from workflow.stage import run_script


def save(folder: Path, name: str, pixels: np.ndarray) -> str:
    with atomic(folder / name) as partial:
        Image.fromarray(pixels).save(partial, "PNG")
    return name


def main(inputs, output, params, run) -> None:
    gains = read_json(inputs.registration)["gains"]
    lenses = read_json(inputs.report)["lenses"]
    video = read_transforms(inputs.dynamic)["frames"]
    folder, entries = Path(output.transforms).parent, []
    Path(output.transforms).unlink(missing_ok=True)  # a folder without it is an unfinished one
    files = zip(params.cameras, listed(inputs.videos), listed(inputs.mattes), params.rates, strict=True)
    for camera, file, mattes, rate in files:
        filmed = {frame["frame"]: frame for frame in video if frame["camera"] == camera}
        listing = {frame["step"]: frame for frame in read_transforms(mattes)["frames"]}
        lens = read_lens(lenses[camera], inputs.report)
        (still,) = room_frames(inputs.room, camera)
        plate = read_pixels(Path(inputs.room).parent / still["file_path"])
        small_plate = None
        for frame in read_frames(file, read_timeline(file, rate), list(filmed)):
            entry, source = filmed[frame.number], listing[frame.number]
            place = Path(mattes).parent / source["file_path"]
            with open_image(place.read_bytes(), place, source.get("sha256")) as image:
                matte = reduced(np.asarray(image.convert("RGBA")), params.width)
            pixels = undistorted(frame.pixels, lens, params.longest)
            if pixels.shape != plate.shape:
                raise InputError(f"{file}: its frames are not of the size of {camera}'s empty picture")
            size = matte.shape[1::-1]
            picture, empty = (
                np.asarray(Image.fromarray(p).resize(size, Image.Resampling.BOX)) for p in (pixels, plate)
            )
            if small_plate is None:
                small_plate = save(folder, f"{camera}.png", empty)
            gain, offset = match_exposure(picture, empty)
            stem = f"{camera}_{frame.number:05d}"
            entries.append(
                {
                    **entry,
                    **reduced_intrinsics(source, size),
                    "file_path": save(folder, f"{stem}_matte.png", matte),
                    "picture": save(folder, f"{stem}.png", picture),
                    "plate": small_plate,
                    "plate_gain": gain.tolist(),
                    "plate_offset": offset.tolist(),
                    "gain": gains[camera],
                }
            )
        run.say(f"{camera}: {len(filmed)} frames")
    write_transforms(output.transforms, {}, entries)


run_script(main, snakemake)
