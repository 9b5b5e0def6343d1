"""One table of what the stages before training reached, a scene a row."""

from neuma_lib.evaluation.text_tables import report_table
from neuma_lib.io.files import read_json, write_text
from workflow.stage import run_script

COLUMNS = {
    "psnr": "PSNR held out [dB]",
    "psnr_object": "PSNR inside [dB]",
    "volume_iou": "volume IoU",
    "gaussians": "Gaussians",
    "particles": "particles",
    "particles_added": "added by binding",
    "velocity_error_in_plane_percent": "velocity error in plane [%]",
    "velocity_error_depth": "error in depth [m/s]",
    "velocity_error_depth_without_ridge": "without ridge [m/s]",
    "velocity_std_depth": "estimated std in depth [m/s]",
    "angular_velocity_error_viewing_percent": "spin error about the viewing axis [%]",
    "angular_velocity_error_percent": "spin error [%]",
}


def main(inputs, output, params, run) -> None:
    reports = {
        scene: read_json(file) for scene, file in zip(params.scenes, list(inputs.reports), strict=True)
    }
    csv, markdown = report_table(reports, COLUMNS, "scene")
    write_text(output.csv, csv)
    write_text(output.markdown, markdown)
    run.log(f"{len(reports)} scenes: {output.markdown}")


run_script(main, snakemake)
