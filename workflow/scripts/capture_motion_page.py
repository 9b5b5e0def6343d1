"""Page of a capture's masks and free flights: checks and pictures."""

import os
from pathlib import Path

from neuma_lib.capture.report.page import markdown, motion_checks
from neuma_lib.io.files import listed, read_json, write_text
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    folder = Path(output.page).parent
    names = [f"{take}, {camera}" for take, camera in params.videos]
    checks = motion_checks(
        read_json(inputs.photographs),
        dict(zip(names, map(read_json, listed(inputs.reports)))),
        dict(zip(params.takes, map(read_json, listed(inputs.flights)))),
    )
    files = {
        "Masks of photographs": inputs.photograph_sheet,
        **{f"Masks: {name}": sheet for name, sheet in zip(names, listed(inputs.sheets))},
        **{f"Free flight: {t}": picture for t, picture in zip(params.takes, listed(inputs.pictures))},
    }
    pictures = {caption: os.path.relpath(file, folder) for caption, file in files.items()}
    missing = None if names else "There are no videos yet."
    write_text(output.page, markdown(params.title, checks, pictures, missing))
    for check in checks:
        run.log(f"{check.what}: {check.value}" + ("" if check.good else f" (expected: {check.wanted})"))


run_script(main, snakemake)
