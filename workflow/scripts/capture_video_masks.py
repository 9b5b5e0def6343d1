"""Mask the object in a video against the picture of the empty scene, and write mattes of the frames that show it."""

from pathlib import Path

import numpy as np

from neuma_lib.capture.frames import contact_sheet, read_frames, read_timeline, sheet_numbers
from neuma_lib.capture.lens import read_lens
from neuma_lib.capture.masks import area_jumps, check_flight, overlay
from neuma_lib.capture.mattes import own_mask, read_pixels, room_frames, world_of, write_mattes
from neuma_lib.capture.pictures import undistorted
from neuma_lib.capture.video_masks import given_masks, video_masks
from neuma_lib.errors import InputError
from neuma_lib.io.files import listed, read_json, write_json
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    (still,) = room_frames(inputs.room, params.camera)
    lens = read_lens(read_json(inputs.report)["lenses"][params.camera], inputs.report)
    timeline = read_timeline(inputs.video, params.rate)
    if (timeline.width, timeline.height) != (lens.width, lens.height):
        raise InputError(
            f"{inputs.video} is {timeline.width}x{timeline.height}, the picture of the empty scene of its camera"
            f" {lens.width}x{lens.height}: save a frame of a video of the same mode as that picture"
        )
    frames = [
        frame._replace(pixels=undistorted(frame.pixels, lens, params.longest))
        for frame in read_frames(inputs.video, timeline)
    ]
    pixels = [frame.pixels for frame in frames]
    # Where -y of the room points in the picture; cameras have OpenGL axes.
    down = -np.array(still["transform_matrix"])[1, :2] * [1.0, -1.0]
    own = {Path(file).stem: file for file in listed(inputs.own)}
    if own:
        found = given_masks(_own(own, lens, params.longest, pixels), timeline.times, down)
    else:
        plate = read_pixels(Path(inputs.room).parent / still["file_path"])
        found = video_masks(pixels, inputs.video, plate, timeline.times, down=down)
    arc = list(found.arcs[0].frames) if found.arcs else None
    if arc and not own:
        check_flight(found.masks, inputs.video, range(arc[0], arc[1] + 1))
    there = np.flatnonzero(found.masks.any(axis=(1, 2)))
    chosen = there[sheet_numbers(len(there))]
    said = f"{len(there)} of {len(frames)} frames show the object"
    said += f", free flight in frames {arc[0]} to {arc[1]}" if arc else ", no free flight was seen"
    contact_sheet(
        output.sheet, [overlay(frames[i], found.masks[i]) for i in chosen], f"{params.name}: {said}"
    )
    mattes = (
        (
            {**still, "file_path": f"{i:05d}.png", "step": int(i), "time": float(timeline.times[i])},
            pixels[i],
            found.masks[i],
        )
        for i in there
    )
    write_mattes(output.transforms, mattes, world_of(inputs.room))
    flying = found.areas[arc[0] : arc[1] + 1] if arc else found.areas[:0]
    write_json(
        output.report,
        {
            "frames": len(frames),
            "shown": there.tolist(),
            "arcs": [list(a.frames) for a in found.arcs],
            "areas": found.areas[there].tolist(),
            "largest_jump": float(area_jumps(flying).max()) if len(flying) > 1 else None,
            "moving": float(found.moving[there].max()),
            "own": len(own),
        },
    )
    run.say(said)


def _own(own, lens, longest, pixels) -> np.ndarray:
    masks = np.zeros((len(pixels), *pixels[0].shape[:2]), bool)
    for stem, file in own.items():
        if not stem.isdecimal() or int(stem) >= len(pixels):
            raise InputError(f"{file}: masks of a video are named after its frames, 0 to {len(pixels) - 1}")
        masks[int(stem)] = own_mask(file, lens, longest)
    return masks


run_script(main, snakemake)
