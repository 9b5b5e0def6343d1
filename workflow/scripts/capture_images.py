"""Collect the image measures of all cameras and takes of a capture in one table."""

from neuma_lib.capture.report.images import image_rows, images_csv
from neuma_lib.io.files import listed, read_json, write_json, write_text
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    entries = []
    for cell, file in zip(params.cells, listed(inputs.measures), strict=True):
        frames = [{k: v for k, v in frame.items() if k != "step"} for frame in read_json(file)["frames"]]
        entries.append({**cell, "frames": frames})
    rows = image_rows(entries)
    write_text(output.csv, images_csv(rows))
    write_json(output.json, rows)
    for row in rows:
        if row["throw"] == "all":
            kind = "training" if row["learned"] else "held-out"
            run.log(
                f"{row['title']}, {kind} frames: PSNR {row['psnr']:.2f} dB, SSIM {row['ssim']:.3f}, LPIPS"
                f" {row['lpips_vgg']:.3f} on the object"
            )


run_script(main, snakemake)
