"""Mask the object in the photographs, check the masks against each other, and write mattes."""

from pathlib import Path

import numpy as np

from neuma_lib.capture.calibration.board import board_outline
from neuma_lib.capture.calibration.lens import read_lens
from neuma_lib.capture.calibration.placement import Similarity
from neuma_lib.capture.calibration.poses import load_poses
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
from neuma_lib.capture.masks.selection import Box, box_in, selected_masks
from neuma_lib.capture.pictures import evidence, group_of, orientation_of, picture_sheet, read_picture
from neuma_lib.config.board import BoardConfig
from neuma_lib.errors import InputError
from neuma_lib.io.files import listed, read_json, write_json
from neuma_lib.io.images import read_transforms
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
    names = [Path(frame["file_path"]).stem for frame in frames]
    pictures = [read_picture(Path(inputs.room).parent / frame["file_path"]) for frame in frames]
    cameras, Ks = map(np.stack, zip(*(metric_camera(frame, {}) for frame in frames)))
    is_own = [name in own for name in names]  # masks of the user are not refined
    boxes = _boxes(listed(inputs.marked), params.object, names, lens, Ks, params.name)
    masks = [np.zeros(0)] * len(names)
    if boxes and not all(is_own):

        def draw_boxes(path: Path) -> None:
            sheet = []
            for k, box in boxes.items():
                inside = np.zeros(pictures[k].shape[:2], bool)
                (x0, y0), (x1, y1) = box.lower.clip(0).astype(int), box.upper.astype(int)
                inside[y0:y1, x0:x1] = True
                sheet.append((names[k], overlay(Frame(0, 0.0, pictures[k]), inside).pixels))
            picture_sheet(path, sheet, f"{params.name}: boxes of the object", 3)

        with evidence(output.sheet, draw_boxes):
            poses = load_poses(inputs.poses, inputs.points)
            masks = selected_masks(
                pictures,
                cameras,
                Ks,
                boxes,
                *_points(poses, names, inputs.room),
                network,
                params.name,
                0.0,
                run.progress,
            )
    for k, (frame, name) in enumerate(zip(frames, names)):
        if is_own[k]:
            masks[k] = own_mask(own[name], lens, params.longest, params.labels)
        elif params.labels:
            masks[k] = np.zeros(pictures[k].shape[:2], np.uint8)
        elif not boxes:
            outline = board_outline(board, params.center, *metric_camera(frame, world)) if board else None
            masks[k] = photograph_mask(pictures[k], network, frame["file_path"], outline)
            run.progress(k + 1, _STEPS * len(frames))
    hidden = [name for name, mask in zip(names, masks) if not mask.any()]
    selected = [k for k, mask in enumerate(masks) if mask.any()]
    frames, names, pictures, masks, is_own = (
        [values[k] for k in selected] for values in (frames, names, pictures, masks, is_own)
    )
    cameras, Ks = cameras[selected], Ks[selected]
    labelled = dict(zip(names, masks)) if params.labels else {}
    masks = [mask > 0 for mask in masks]
    ious = np.ones(1)

    def draw(path: Path) -> None:
        sheet = [
            (f"{name}: {value:.2f}", overlay(Frame(0, 0.0, pixels), mask).pixels)
            for name, value, pixels, mask in zip(names, ious, pictures, masks)
        ]
        picture_sheet(path, sheet, f"{params.name}: IoU of the masks with their visual hull", 6)

    def progress(done: int, total: int) -> None:
        run.progress(total + (_STEPS - 1) * done, _STEPS * total)

    if len(masks) > 1:
        with evidence(output.sheet, draw):
            ious = np.zeros(len(masks))  # if there is no common body
            ious = agreement(masks, cameras, Ks)
            unrefined = [k for k, own_one in enumerate(is_own) if not own_one]
            if unrefined:
                check_masks(ious[unrefined], params.name)
        if not boxes:
            masks = refined_masks(pictures, masks, cameras, Ks, is_own, progress)
            ious = agreement(masks, cameras, Ks)
    with evidence(output.sheet, draw):
        doubtful = _check(ious, names, is_own, params.name)
    kept = [name not in doubtful for name in names]
    sheet = [
        (f"{name}: {value:.2f}{'' if good else ', left out'}", overlay(Frame(0, 0.0, pixels), mask).pixels)
        for name, value, good, pixels, mask in zip(names, ious, kept, pictures, masks)
    ]
    total, left_out = len(names) + len(hidden), hidden + doubtful
    summary = f"{sum(kept)} of {total} masks agree, mean IoU {np.mean(ious[kept]):.2f} with their visual hull"
    picture_sheet(output.sheet, sheet, f"{params.name}: {summary}", 6)
    mattes = [
        ({**frame, "file_path": f"{name}.png"}, pixels, labelled.get(name, mask))
        for frame, name, pixels, mask, good in zip(frames, names, pictures, masks, kept)
        if good
    ]
    # The object lies on the floor of the room (neuma_lib.config.photographs).
    write_mattes(output.transforms, mattes, {**world_of(inputs.room), "photographs": {"floor": 0.0}})
    write_json(
        output.report,
        {
            "photographs": total,
            "agreement": dict(zip(names, ious.tolist())),
            "left_out": left_out,
            "boxes": sorted(params.object),
            "own": sorted(own),
        },
    )
    run.log(summary + (f", left out: {', '.join(left_out)}" if left_out else ""))


def _boxes(marked, rectangles, names, lens, Ks, name) -> dict[int, Box]:
    """Boxes of the settings by number of the photograph, without photographs that have no camera."""
    boxes = {}
    for file in map(Path, marked):
        if file.stem in names:
            k, orientation = names.index(file.stem), orientation_of(file, (lens.width, lens.height))
            boxes[k] = box_in(rectangles[file.name], orientation, lens, Ks[k])
    if rectangles and not boxes:
        problem = "no photograph with a box has a camera pose"
        raise InputError(f"{name}: object", problem, "Draw the box in another photograph")
    return boxes


def _points(poses, names, room) -> tuple[np.ndarray, np.ndarray]:
    """Points of the reconstruction in the world of the room's file, and which photographs show them."""
    data = read_transforms(room)
    points = Similarity.read(data["room"]).apply(poses.points)
    world = data.get("world", {})
    named = {Path(name).stem: name for name in poses.names if group_of(name) == PHOTOGRAPHS}
    seen = poses.seen([named[name] for name in names])
    return world.get("scale", 1.0) * points + np.array(world.get("offset", 0.0)), seen


def _check(ious, names, is_own, name) -> list[str]:
    """Photographs whose masks do not agree with the others."""
    doubtful = [n for n, value, own in zip(names, ious, is_own) if value < MIN_AGREEMENT and not own]
    if len(doubtful) > 0.5 * len(names):
        raise InputError(
            name,
            f"{len(doubtful)} of {len(names)} masks of photographs disagree with the others"
            f" ({', '.join(doubtful[:5])}), at most half may",
            "Select the object with a box (`object` in capture.yaml), photograph it alone in front of a background of"
            f" another colour, or put masks into the folder masks/{PHOTOGRAPHS}",
        )
    return doubtful


run_script(main, snakemake)
