"""Make poses metric and upright, place them in the simulation box, and undistort the pictures."""

from pathlib import Path

from neuma_lib.capture.calibration.drawing import draw_floor, draw_poses, draw_room
from neuma_lib.capture.calibration.poses import load_poses
from neuma_lib.capture.calibration.room import find_room, write_room
from neuma_lib.capture.calibration.vertical import check_vertical
from neuma_lib.capture.pictures import evidence, name_pictures
from neuma_lib.config.capture import CaptureConfig
from neuma_lib.io.files import listed, write_json
from neuma_lib.project.capture_folder import PHOTOGRAPHS
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    settings = CaptureConfig(**params.settings)
    groups = {PHOTOGRAPHS: listed(inputs.photographs)} | {Path(f).stem: [f] for f in listed(inputs.stills)}
    pictures = name_pictures(groups)
    poses = load_poses(inputs.poses, inputs.points)
    with evidence(output.floor, lambda path: draw_poses(path, poses)):
        room = find_room(poses, pictures, settings)
    report = write_room(output.transforms, room, pictures, settings)
    draw_room(output.cameras, room)
    draw_floor(output.floor, output.transforms)
    write_json(output.report, report)
    if room.board:
        run.log(
            f"{len(room.board.corners)} corners of the board, residual {1000 * room.board.residual:.2f} mm"
        )
    elif room.floor is not None:
        run.log(f"{100 * room.floor:.0f} % of the points lie on the floor")
    run.log(check_vertical(room.cues, PHOTOGRAPHS))


run_script(main, snakemake)
