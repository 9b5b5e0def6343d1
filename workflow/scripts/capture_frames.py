"""Read when the frames of a video were taken, and show some of them."""

from neuma_lib.capture.frames import contact_sheet, read_frames, read_timeline, sheet_numbers
from neuma_lib.io.files import write_json
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    timeline = read_timeline(inputs.video, params.rate)
    shown = list(read_frames(inputs.video, timeline, sheet_numbers(len(timeline.times))))
    said = f"{len(timeline.times)} frames, {timeline.rate:.2f} a second"
    if timeline.stretch != 1:
        said += f" ({timeline.stretch:g} times as many as the file says)"
    if len(timeline.lost):
        said += f", missing before frames {', '.join(map(str, timeline.lost[:5]))}"
        said += " and others" if len(timeline.lost) > 5 else ""
    contact_sheet(output.sheet, shown, f"{params.name}: {said}")
    write_json(output.timeline, timeline.plain())
    run.say(said)


run_script(main, snakemake)
