"""Mask the object in a video with the picture of the empty scene, and write mattes of the frames that show it."""

from pathlib import Path

import numpy as np

from neuma_lib.capture.calibration.lens import read_lens
from neuma_lib.capture.frames import contact_sheet, read_frames, read_timeline, sheet_numbers
from neuma_lib.capture.masks.mattes import own_mask, room_frames, world_of, write_mattes
from neuma_lib.capture.masks.regions import area_jumps, check_flight, overlay
from neuma_lib.capture.masks.video_masks import given_masks, video_masks
from neuma_lib.capture.pictures import read_picture, undistorted
from neuma_lib.errors import InputError
from neuma_lib.io.files import listed, read_json, write_json
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    (still,) = room_frames(inputs.room, params.camera)
    lens = read_lens(read_json(inputs.report)["lenses"][params.camera], inputs.report)
    timeline = read_timeline(inputs.video, params.rate)
    if (timeline.width, timeline.height) != (lens.width, lens.height):
        raise InputError(
            inputs.video,
            f"the video is {timeline.width}x{timeline.height}, the picture of the empty scene of its camera"
            f" {lens.width}x{lens.height}",
            "Save a frame of a video in the same mode as that picture",
        )
    frames = [
        frame._replace(pixels=undistorted(frame.pixels, lens, params.longest))
        for frame in read_frames(inputs.video, timeline)
    ]
    pixels = [frame.pixels for frame in frames]
    # Direction of -y of the room in the picture. Cameras have OpenGL axes.
    down = -np.array(still["transform_matrix"])[1, :2] * [1.0, -1.0]
    own = {Path(file).stem: file for file in listed(inputs.own)}
    if own:
        result = given_masks(_own(own, lens, params.longest, pixels), timeline.times, down)
    else:
        background = read_picture(Path(inputs.room).parent / still["file_path"])
        result = video_masks(pixels, inputs.video, background, timeline.times, down=down)
    masks, areas = result.masks, result.areas
    flight = list(result.tracks[0].frames) if result.tracks else None
    if flight and not own:
        check_flight(masks, inputs.video, range(flight[0], flight[1] + 1))
    visible = np.flatnonzero(masks.any(axis=(1, 2)))
    chosen = visible[sheet_numbers(len(visible))]
    summary = f"{len(visible)} of {len(frames)} frames show the object"
    summary += (
        f", free flight in frames {flight[0]} to {flight[1]}" if flight else ", no free flight detected"
    )
    sheet = [overlay(frames[i], masks[i]) for i in chosen]
    contact_sheet(output.sheet, sheet, f"{params.name}: {summary}")
    mattes = (
        (
            {**still, "file_path": f"{i:05d}.png", "step": int(i), "time": float(timeline.times[i])},
            pixels[i],
            masks[i],
        )
        for i in visible
    )
    write_mattes(output.transforms, mattes, world_of(inputs.room))
    flying = areas[flight[0] : flight[1] + 1] if flight else areas[:0]
    write_json(
        output.report,
        {
            "frames": len(frames),
            "shown": visible.tolist(),
            "arcs": [list(a.frames) for a in result.tracks],
            "areas": areas[visible].tolist(),
            "largest_jump": float(area_jumps(flying).max()) if len(flying) > 1 else None,
            "moving": float(result.moving[visible].max()),
            "own": len(own),
        },
    )
    run.log(summary)


def _own(own, lens, longest, pixels) -> np.ndarray:
    masks = np.zeros((len(pixels), *pixels[0].shape[:2]), bool)
    for stem, file in own.items():
        if not stem.isdecimal() or int(stem) >= len(pixels):
            raise InputError(
                file, f"it must be named after a frame of the video, 0 to {len(pixels) - 1}", "Rename it"
            )
        masks[int(stem)] = own_mask(file, lens, longest)
    return masks


run_script(main, snakemake)
