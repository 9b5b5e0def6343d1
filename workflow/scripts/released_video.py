"""Mattes of the frames of one camera of a released capture, with their times and the frames of free flight."""

import numpy as np

from neuma_lib.capture.frames import Frame, contact_sheet, sheet_numbers
from neuma_lib.capture.masks.mattes import write_mattes
from neuma_lib.capture.masks.regions import area_jumps, overlay
from neuma_lib.capture.released import RATE, read_configured, read_shots, video_frames
from neuma_lib.config.capture import ReleasedConfig
from neuma_lib.io.files import write_json
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    settings = ReleasedConfig(**params.settings)
    capture = read_configured(params.name, settings)
    shots = capture.videos[params.camera]
    frames, world = video_frames(shots, capture.ground, settings.scale, settings.longest, settings.enlarge)
    pictures, masks = zip(*read_shots(shots, settings.longest))
    write_mattes(output.transforms, zip(frames, pictures, masks, strict=True), world)
    numbers = [shot.number for shot in shots]
    flying = [number for number in numbers if number < capture.contact]
    summary = f"{len(shots)} frames, free flight in frames {flying[0]} to {flying[-1]}"
    sheet = [
        overlay(Frame(shots[i].number, frames[i]["time"], pictures[i]), masks[i])
        for i in sheet_numbers(len(shots))
    ]
    contact_sheet(output.sheet, sheet, f"{params.name}, {params.camera}: {summary}")
    areas = [int(mask.sum()) for mask in masks]
    jump = float(area_jumps(np.array(areas[: len(flying)])).max()) if len(flying) > 1 else None
    report = {"frames": len(shots), "shown": numbers, "arcs": [[flying[0], flying[-1]]], "areas": areas}
    write_json(output.report, {**report, "largest_jump": jump, "moving": 0.0, "own": len(shots)})
    timeline = {"frames": len(shots), "rate": RATE, "steady": True, "stretch": 1.0}
    timeline |= {"lost_before": [], "repeated": []}
    size = {"width": shots[0].lens.width, "height": shots[0].lens.height}
    times = [frame["time"] for frame in frames]
    write_json(output.timeline, {**timeline, **size, "times_s": np.asarray(times).tolist()})
    run.log(summary)


run_script(main, snakemake)
