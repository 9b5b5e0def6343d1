"""Mask the object in a video with the picture of the empty scene, and write mattes of the frames that show it."""

from pathlib import Path

import numpy as np

from neuma_lib.capture.calibration.lens import read_lens
from neuma_lib.capture.frames import (
    Frame,
    StoredPictures,
    contact_sheet,
    read_frames,
    sheet_numbers,
    timeline_of,
)
from neuma_lib.capture.masks.camera_motion import background_shift, check_fixed
from neuma_lib.capture.masks.mattes import own_mask, room_frames, world_of, write_mattes
from neuma_lib.capture.masks.regions import area_jumps, check_flight, overlay
from neuma_lib.capture.masks.video_masks import find_flight_window, given_masks, video_masks
from neuma_lib.capture.pictures import evidence, read_picture, undistorted
from neuma_lib.capture.tools import opencv
from neuma_lib.errors import InputError
from neuma_lib.io.files import listed, read_json, write_json
from workflow.stage import run_script

_SEARCH = 500  # longer side of the pictures in which the flight is searched [px]
_MARGIN = 0.15  # time after the used part of the video that is masked as well [s]
_COMPARED = 40  # frames whose background is compared with the empty scene


def main(inputs, output, params, run) -> None:
    (still,) = room_frames(inputs.room, params.camera)
    lens = read_lens(read_json(inputs.report)["lenses"][params.camera], inputs.report)
    timeline = timeline_of(read_json(inputs.timeline))
    if (timeline.width, timeline.height) != (lens.width, lens.height):
        raise InputError(
            inputs.video,
            f"the video is {timeline.width}x{timeline.height}, the picture of the empty scene of its camera"
            f" {lens.width}x{lens.height}",
            "Save a frame of a video in the same mode as that picture",
        )
    background = read_picture(Path(inputs.room).parent / still["file_path"])
    # Direction of -y of the room in the picture. Cameras have OpenGL axes.
    down = -np.array(still["transform_matrix"])[1, :2] * [1.0, -1.0]
    own = {Path(file).stem: file for file in listed(inputs.own)}
    body = 1 + list(params.labels).index(params.body) if params.body else None
    if own:
        numbers, shift = _named(own, len(timeline.times)), None
    else:
        search = inputs.video, timeline, lens, background, down
        numbers, shift = _search(*search, params, output.sheet)
    pictures = StoredPictures(
        undistorted(frame.pixels, lens, params.longest)
        for frame in read_frames(inputs.video, timeline, numbers)
    )

    def frame(k: int) -> Frame:
        return Frame(int(numbers[k]), float(timeline.times[numbers[k]]), pictures[k])

    def draw_frames(path: Path) -> None:
        contact_sheet(path, [frame(k) for k in sheet_numbers(len(pictures))], params.name)

    with evidence(output.sheet, draw_frames):
        if own:
            files = {int(stem): file for stem, file in own.items()}
            labels = np.stack([own_mask(files[n], lens, params.longest, params.labels) for n in numbers])
            result = given_masks(_of_body(labels, params, body), timeline.times[numbers], down)
        else:
            result = video_masks(pictures, inputs.video, background, timeline.times[numbers], down=down)
    masks, areas = result.masks, result.areas
    flight = list(result.tracks[0].frames) if result.tracks else None
    visible = np.flatnonzero(masks.any(axis=(1, 2)))
    breaks = [b._replace(first=int(numbers[b.first]), last=int(numbers[b.last])) for b in result.breaks]
    summary = f"{len(visible)} of {len(timeline.times)} frames used, {numbers[visible[0]]} to {numbers[visible[-1]]}"
    summary += (
        f", free flight in frames {numbers[flight[0]]} to {numbers[flight[1]]}"
        if flight
        else ", no free flight detected"
    )
    left_out = "; ".join(map(str, breaks[:3])) + ("; and others" if len(breaks) > 3 else "")

    def draw_masks(path: Path) -> None:
        sheet = [overlay(frame(k), masks[k]) for k in visible[sheet_numbers(len(visible))]]
        contact_sheet(
            path, sheet, f"{params.name}: {summary}" + (f". Left out: {left_out}" if breaks else "")
        )

    with evidence(output.sheet, draw_masks):
        if flight and not own:
            check_flight(masks, inputs.video, range(flight[0], flight[1] + 1))
    draw_masks(output.sheet)
    mattes = (
        (
            {**still, "file_path": f"{number:05d}.png", "step": number, "time": time},
            pixels,
            labels[k] if params.labels else masks[k],
        )
        for k in visible
        for number, time, pixels in [frame(k)]
    )
    write_mattes(output.transforms, mattes, world_of(inputs.room), body)
    flying = areas[flight[0] : flight[1] + 1] if flight else areas[:0]
    write_json(
        output.report,
        {
            "frames": len(timeline.times),
            "shown": numbers[visible].tolist(),
            "arcs": [numbers[list(track.frames)].tolist() for track in result.tracks],
            "areas": areas[visible].tolist(),
            "largest_jump": float(area_jumps(flying).max()) if len(flying) > 1 else None,
            "moving": float(result.moving[visible].max()),
            "left_out": [each.plain() for each in breaks],
            "camera_shift": shift,
            "own": len(own),
        },
    )
    run.log(summary)
    for each in breaks:
        run.log(f"left out, {each}")


def _search(video, timeline, lens, background, down, params, output) -> tuple[np.ndarray, float]:
    """Numbers of the frames near the flight, and the largest shift of the background as share of the picture.

    The whole video is read once, at reduced size.
    """
    longest = min(_SEARCH, params.longest)
    small = lens.pinhole().resized(longest)
    empty = opencv().resize(background, (small.width, small.height), interpolation=opencv().INTER_AREA)
    compared = set(timeline.numbers[sheet_numbers(len(timeline.numbers), _COMPARED)].tolist())
    shifts, sheet = {}, []

    def pictures():
        for frame in read_frames(video, timeline):
            pixels = undistorted(frame.pixels, lens, longest)
            if frame.number in compared:
                shifts[frame.number] = background_shift(empty, pixels)
                sheet.append(frame._replace(pixels=pixels))
            yield pixels

    times = timeline.times[timeline.numbers]
    window = find_flight_window(pictures(), empty, times, params.duration + _MARGIN, down)
    text = f"{params.name}: the empty scene first, then frames of the video"
    first = Frame(-1, 0.0, empty)
    with evidence(output, lambda path: contact_sheet(path, [first, *sheet[::2]], text)):
        shift = check_fixed(list(shifts.values()), list(shifts), longest, video)
    return timeline.numbers[window], shift


def _of_body(labels, params, body) -> np.ndarray:
    """Masks (T, H, W) of the object, or of one of several bodies. Raises InputError if no frame shows it."""
    masks = labels == body if body else labels > 0
    if not masks.any():
        problem = f"no mask has the label {params.labels[params.body]} of {params.body}"
        raise InputError(params.name, problem, "Correct the masks, or `bodies` in capture.yaml")
    return masks


def _named(own, count) -> np.ndarray:
    """Numbers of the frames with masks of the user, in order."""
    for stem, file in own.items():
        if not stem.isdecimal() or int(stem) >= count:
            raise InputError(
                file, f"it must be named after a frame of the video, 0 to {count - 1}", "Rename it"
            )
    return np.array(sorted(map(int, own)))


run_script(main, snakemake)
