"""Read the capture times of the frames of a video, and write a contact sheet."""

from neuma_lib.capture.frames import contact_sheet, read_frames, read_timeline, sheet_numbers
from neuma_lib.io.files import write_json
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    timeline = read_timeline(inputs.video, params.rate)
    frames = list(read_frames(inputs.video, timeline, timeline.numbers[sheet_numbers(len(timeline.numbers))]))
    summary = f"{len(timeline.times)} frames, {timeline.rate:.2f} per second"
    if timeline.stretch != 1:
        summary += f" ({timeline.stretch:g} times the rate of the file)"
    if len(timeline.lost):
        summary += f", missing before frames {', '.join(map(str, timeline.lost[:5]))}"
        summary += " and others" if len(timeline.lost) > 5 else ""
    if len(timeline.repeated):
        summary += f", {len(timeline.repeated)} left out that repeat the previous picture"
    contact_sheet(output.sheet, frames, f"{params.name}: {summary}")
    write_json(output.timeline, timeline.plain())
    run.log(summary)


run_script(main, snakemake)
