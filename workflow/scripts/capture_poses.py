"""Estimate the cameras of photographs and stills, and points of the scene."""

import tempfile
from pathlib import Path

from neuma_lib.capture.calibration.drawing import draw_poses
from neuma_lib.capture.calibration.poses import find_poses, save_poses
from neuma_lib.capture.frames import sheet_numbers
from neuma_lib.capture.pictures import evidence, picture_sheet, read_picture
from neuma_lib.config.capture import BoardConfig
from neuma_lib.io.files import listed
from neuma_lib.project.capture_folder import PHOTOGRAPHS
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    groups = {PHOTOGRAPHS: listed(inputs.photographs)} | {Path(f).stem: [f] for f in listed(inputs.stills)}
    run.log(f"{len(groups[PHOTOGRAPHS])} photographs, {len(groups) - 1} fixed cameras")
    given, lenses = listed(inputs.given), listed(inputs.lenses)

    def draw_photographs(path: Path) -> None:
        sheet = []
        for k in sheet_numbers(len(groups[PHOTOGRAPHS])):
            pixels = read_picture(groups[PHOTOGRAPHS][k])
            step = max(1, pixels.shape[1] // 400)
            sheet.append((Path(groups[PHOTOGRAPHS][k]).name, pixels[::step, ::step].copy()))
        picture_sheet(path, sheet, "photographs", 6)

    folder = tempfile.TemporaryDirectory(dir=Path(output.poses).parent, prefix=".colmap-")
    with evidence(output.picture, draw_photographs), folder as work:
        poses = find_poses(
            groups,
            given[0] if given else params.poses,
            work,
            lenses[0] if lenses else None,
            BoardConfig(**params.board) if params.board else None,
            params.seed,
            snakemake.threads,
        )
    draw_poses(output.picture, poses)
    save_poses(output.poses, output.points, poses)
    run.log(
        f"{len(poses.names)} of {len(poses.names) + len(poses.lost)} pictures registered, {len(poses.points)} points,"
        f" reprojection error {poses.error:.2f} px"
    )


run_script(main, snakemake)
