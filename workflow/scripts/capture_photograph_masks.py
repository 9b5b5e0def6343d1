"""Mask the object in the photographs, check the masks against each other, and write mattes."""

from pathlib import Path

import numpy as np

from neuma_lib.capture.calibration.board import board_outline
from neuma_lib.capture.calibration.lens import read_lens
from neuma_lib.capture.frames import Frame
from neuma_lib.capture.gates import check_masks
from neuma_lib.capture.masks.agreement import MIN_AGREEMENT, agreement
from neuma_lib.capture.masks.mask_refinement import refined_masks
from neuma_lib.capture.masks.mattes import (
    metric_camera,
    own_mask,
    room_frames,
    world_of,
    write_mattes,
)
from neuma_lib.capture.masks.photograph_masks import photograph_mask
from neuma_lib.capture.masks.regions import overlay
from neuma_lib.capture.masks.saliency import Saliency
from neuma_lib.capture.pictures import evidence, picture_sheet, read_picture
from neuma_lib.config.board import BoardConfig
from neuma_lib.errors import InputError
from neuma_lib.io.files import listed, read_json, write_json
from neuma_lib.project.capture_folder import PHOTOGRAPHS
from workflow.stage import run_script

_STEPS = 4  # of progress, one for the network's masks


def main(inputs, output, params, run) -> None:
    frames = room_frames(inputs.room, PHOTOGRAPHS)
    lens = read_lens(read_json(inputs.report)["lenses"][PHOTOGRAPHS], inputs.report)
    own = {Path(file).stem: file for file in listed(inputs.own)}
    network = Saliency(listed(inputs.network)[0]) if listed(inputs.network) else None
    board = BoardConfig(**params.board) if params.board else None
    world = world_of(inputs.room).get("world", {})
    names, pictures, masks = [], [], []
    for number, frame in enumerate(frames):
        file = Path(inputs.room).parent / frame["file_path"]
        pixels = read_picture(file)
        if file.stem in own:
            mask = own_mask(own[file.stem], lens, params.longest)
        else:
            outline = board_outline(board, params.center, *metric_camera(frame, world)) if board else None
            mask = photograph_mask(pixels, network, frame["file_path"], outline)
        names.append(file.stem)
        pictures.append(pixels)
        masks.append(mask)
        run.progress(number + 1, _STEPS * len(frames))
    cameras, Ks = map(np.stack, zip(*(metric_camera(frame, {}) for frame in frames)))
    is_own = [name in own for name in names]  # masks of the user are not refined
    ious = np.ones(1)

    def draw(path: Path) -> None:
        sheet = [
            (f"{name}: {value:.2f}", overlay(Frame(0, 0.0, pixels), mask).pixels)
            for name, value, pixels, mask in zip(names, ious, pictures, masks)
        ]
        picture_sheet(path, sheet, f"{params.name}: IoU of the masks with their visual hull", 6)

    if len(masks) > 1:
        with evidence(output.sheet, draw):
            ious = np.zeros(len(masks))  # if there is no common body
            ious = agreement(masks, cameras, Ks)
            unrefined = [k for k, own_one in enumerate(is_own) if not own_one]
            if unrefined:
                check_masks(ious[unrefined], params.name)

        def progress(done: int, total: int) -> None:
            run.progress(total + (_STEPS - 1) * done, _STEPS * total)

        masks = refined_masks(pictures, masks, cameras, Ks, is_own, progress)
        ious = agreement(masks, cameras, Ks)
    with evidence(output.sheet, draw):
        doubtful = _check(ious, names, is_own, params.name)
    kept = [name not in doubtful for name in names]
    sheet = [
        (f"{name}: {value:.2f}{'' if good else ', left out'}", overlay(Frame(0, 0.0, pixels), mask).pixels)
        for name, value, good, pixels, mask in zip(names, ious, kept, pictures, masks)
    ]
    summary = (
        f"{sum(kept)} of {len(names)} masks agree, mean IoU {np.mean(ious[kept]):.2f} with their visual hull"
    )
    picture_sheet(output.sheet, sheet, f"{params.name}: {summary}", 6)
    mattes = [
        ({**frame, "file_path": f"{name}.png"}, pixels, mask)
        for frame, name, pixels, mask, good in zip(frames, names, pictures, masks, kept)
        if good
    ]
    # The object lies on the floor of the room (neuma_lib.config.photographs).
    write_mattes(output.transforms, mattes, {**world_of(inputs.room), "photographs": {"floor": 0.0}})
    write_json(
        output.report,
        {
            "photographs": len(names),
            "agreement": dict(zip(names, ious.tolist())),
            "left_out": doubtful,
            "own": sorted(own),
        },
    )
    run.log(summary + (f", left out: {', '.join(doubtful)}" if doubtful else ""))


def _check(ious, names, is_own, name) -> list[str]:
    """Photographs whose masks do not agree with the others."""
    doubtful = [n for n, value, own in zip(names, ious, is_own) if value < MIN_AGREEMENT and not own]
    if len(doubtful) > 0.5 * len(names):
        raise InputError(
            name,
            f"{len(doubtful)} of {len(names)} masks of photographs disagree with the others"
            f" ({', '.join(doubtful[:5])}), at most half may",
            "Photograph the whole object alone in front of a background of another colour, or put masks into the folder"
            f" masks/{PHOTOGRAPHS}",
        )
    return doubtful


run_script(main, snakemake)
