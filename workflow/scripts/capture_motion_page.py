"""One page of a capture's masks and free flights: checks and pictures."""

from pathlib import Path

from neuma_lib.capture.agreement import LEAST_AGREEMENT
from neuma_lib.capture.flight import flight_checks
from neuma_lib.capture.page import Check, markdown
from neuma_lib.io.files import read_json, write_text
from workflow.inputs import listed
from workflow.stage import run_script

MOST_JUMP = 0.1
"""Change of a mask's area from frame to frame of free flight that good masks stay below."""


def main(inputs, output, params, run) -> None:
    home = Path(output.page).parent
    names = [f"{throw}, {camera}" for throw, camera in params.videos]
    photographs = read_json(inputs.photographs)
    out = photographs["left_out"]
    text = f"{photographs['photographs'] - len(out)} of {photographs['photographs']}"
    checks = [
        Check(
            f"masks of photographs that agree (IoU > {LEAST_AGREEMENT})",
            text + (f" (not {', '.join(out)})" if out else ""),
            "nearly all",
            len(out) <= 0.1 * photographs["photographs"],
        )
    ]
    for name, report in zip(names, map(read_json, listed(inputs.reports))):
        jump = report["largest_jump"]
        found = "no free flight" if jump is None else f"{100 * jump:.1f} %"
        checks.append(
            Check(f"area of {name}, frame to frame", found, "< 10 %", jump is not None and jump < MOST_JUMP)
        )
    for throw, flight in zip(params.throws, map(read_json, listed(inputs.flights))):
        checks += [Check(*values) for values in flight_checks(throw, flight)]
    files = {
        "Masks of photographs": inputs.photograph_sheet,
        **{f"Masks: {name}": sheet for name, sheet in zip(names, listed(inputs.sheets))},
        **{f"Free flight: {t}": picture for t, picture in zip(params.throws, listed(inputs.pictures))},
    }
    pictures = {caption: str(Path(file).relative_to(home)) for caption, file in files.items()}
    missing = None if names else "There are no videos yet."
    write_text(output.page, markdown(params.title, checks, pictures, missing))
    for check in checks:
        run.say(f"{check.what}: {check.found}" + ("" if check.good else f" (wanted: {check.wanted})"))


run_script(main, snakemake)
