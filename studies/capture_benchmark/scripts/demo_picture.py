"""Contact sheet of the demo captures: a photograph, the empty scene, and frames of a drop."""

from pathlib import Path

from neuma_lib.capture.frames import read_frames, read_timeline
from neuma_lib.capture.pictures import picture_sheet, read_picture
from neuma_lib.io.files import listed
from workflow.stage import run_script

COLUMNS = 4


def main(inputs, output, params, run) -> None:
    sheet = []
    files = (inputs.photographs, inputs.stills, inputs.videos)
    for name, photograph, still, video in zip(params.names, *map(listed, files), strict=True):
        sheet.append((f"{name}, a photograph", read_picture(Path(photograph))))
        sheet.append((f"{name}, the empty scene", read_picture(Path(still))))
        timeline = read_timeline(video)
        last = len(timeline.times) - 1
        for number, _, pixels in read_frames(video, timeline, [last // 4, last // 2]):
            sheet.append((f"{name}, frame {number} of its first drop", pixels))
    picture_sheet(output.picture, sheet, "The demo captures", COLUMNS)


run_script(main, snakemake)
