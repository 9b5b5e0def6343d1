"""Mattes of the photographs of a released capture, at approximately the scale of its videos."""

import numpy as np

from neuma_lib.capture.frames import Frame
from neuma_lib.capture.masks.agreement import agreement
from neuma_lib.capture.masks.mattes import metric_camera, write_mattes
from neuma_lib.capture.masks.regions import overlay
from neuma_lib.capture.pictures import picture_sheet
from neuma_lib.capture.released import (
    photographs_about_to_size,
    read_configured,
    read_shots,
    room_cameras,
    seen_size,
)
from neuma_lib.config.capture import ReleasedConfig
from neuma_lib.io.files import write_json
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    settings = ReleasedConfig(**params.settings)
    capture = read_configured(params.name, settings)
    first = [shots[0] for shots in capture.videos.values()]
    viewmats = room_cameras(np.stack([shot.viewmat for shot in first]), capture.ground, settings.scale)
    lenses = [shot.lens.resized(settings.longest) for shot in first]
    filmed = [mask for _, mask in read_shots(first, settings.longest)]
    middle, radius = seen_size(filmed, viewmats, np.stack([lens.K for lens in lenses]))
    pictures, masks = [], []
    for number, (pixels, mask) in enumerate(read_shots(capture.photographs, settings.longest)):
        pictures.append(pixels)
        masks.append(mask)
        run.progress(number + 1, len(capture.photographs))
    size, height = settings.enlarge * radius, settings.enlarge * float(middle[1])
    frames, world = photographs_about_to_size(capture.photographs, masks, settings.longest, size, height)
    cameras, Ks = map(np.stack, zip(*(metric_camera(frame, {}) for frame in frames)))
    ious = agreement(masks, cameras, Ks)
    names = [shot.picture.stem for shot in capture.photographs]
    summary = f"{len(names)} photographs, mean IoU {ious.mean():.2f} of their masks with their visual hull"
    sheet = [
        (f"{name}: {value:.2f}", overlay(Frame(0, 0.0, pixels), mask).pixels)
        for name, value, pixels, mask in zip(names, ious, pictures, masks)
    ]
    picture_sheet(output.sheet, sheet, f"{params.name}: {summary}", 6)
    write_mattes(output.transforms, zip(frames, pictures, masks, strict=True), world)
    report = {"photographs": len(names), "agreement": dict(zip(names, ious.tolist())), "left_out": []}
    write_json(output.report, {**report, "own": names})
    run.log(summary)


run_script(main, snakemake)
