"""Page of a capture: checks and pictures."""

from pathlib import Path

from neuma_lib.capture.report.page import checks, markdown
from neuma_lib.io.files import listed, read_json, write_text
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    folder = Path(output.page).parent
    names = [f"{take}, {camera}" for take, camera in params.videos]
    results = checks(read_json(inputs.room), dict(zip(names, map(read_json, listed(inputs.timelines)))))
    files = {
        "Cameras and points": inputs.cameras,
        "Floor and box": inputs.floor,
        **{f"Frames: {name}": sheet for name, sheet in zip(names, listed(inputs.sheets))},
    }
    pictures = {caption: str(Path(file).relative_to(folder)) for caption, file in files.items()}
    missing = None if names else "There are no videos yet."
    write_text(output.page, markdown(params.title, results, pictures, missing))
    for check in results:
        run.log(f"{check.what}: {check.value}" + ("" if check.good else f" (expected: {check.wanted})"))


run_script(main, snakemake)
