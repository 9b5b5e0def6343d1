"""Fit the free flight of a take in all cameras, and check gravity."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from neuma_lib.capture.calibration.vertical import read_cues
from neuma_lib.capture.masks.agreement import check_one_object
from neuma_lib.capture.masks.mattes import Mattes, metric_camera
from neuma_lib.capture.motion.flight import Filmed, draw_flight, draw_tracks, find_flight, report
from neuma_lib.capture.motion.timing import read_sound
from neuma_lib.capture.pictures import evidence, group_of
from neuma_lib.io.files import listed, read_json, write_json
from neuma_lib.io.images import read_transforms
from neuma_lib.project.capture_folder import PHOTOGRAPHS
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    videos = inputs.get("videos")
    files = zip(
        params.cameras,
        listed(videos) if videos else [None] * len(params.cameras),
        listed(inputs.transforms),
        listed(inputs.reports),
        listed(inputs.timelines),
        params.timing["offsets"],
        params.timing["row_times"],
        strict=True,
    )
    views = [filmed(*values) for values in files]
    room = inputs.get("room")
    with evidence(output.picture, lambda path: draw_tracks(path, views, params.name)):
        cues = read_cues(read_json(room)["up"]) if room else ()
        flight = find_flight(views, params.name, params.metric, cues)
        if params.get("hidden"):
            flight = replace(flight, agreement=None)
        if room and flight.agreement is not None:
            check_one_object(flight.agreement, params.cameras, params.name)
        if room and not params.metric:
            centres = read_json(room)["centres_m"]
            places = {Path(n).name: place for n, place in centres.items() if group_of(n) == PHOTOGRAPHS}
            raise flight.fall.gravity.known_length(places, params.name)
    draw_flight(output.picture, flight, views, flight.gravity)
    write_json(output.flight, report(flight, views))
    for line in [*flight.offsets_from, flight.gravity]:
        run.log(line)
    if flight.spin:
        size, deviation = flight.spin.rate
        run.log(f"spin {size:.2f} +- {deviation:.2f} rad/s from {flight.spin.points} points")


def filmed(camera, video, transforms, masks, timeline, offset, row_time) -> Filmed:
    data, timeline, mattes = read_transforms(transforms), read_json(timeline), Mattes(transforms)
    flights = read_json(masks)["arcs"]
    viewmat, K = metric_camera(data["frames"][0], data.get("world", {}))
    return Filmed(
        camera,
        np.array([frame["step"] for frame in data["frames"]]),
        np.array([frame["time"] for frame in data["frames"]]),
        mattes,
        np.stack([matte[..., 3] > 127 for matte in mattes]),
        tuple(flights[0]) if flights else None,
        viewmat,
        K,
        timeline["height"],
        row_time,
        # The sound of slow motion is not slowed.
        read_sound(Path(video)) if video and timeline["stretch"] == 1 else None,
        offset,
    )


run_script(main, snakemake)
