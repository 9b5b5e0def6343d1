"""The room of the demo captures: pictures on floor, walls and page, and what each video camera sees of it, empty."""

import numpy as np

from neuma_lib.capture.board import black_rectangles
from neuma_lib.config.board import PAPERS
from neuma_lib.config.demo_captures import DemoCapturesConfig
from neuma_lib.data.demo_captures.filming import plates, scenery
from neuma_lib.data.demo_captures.pictures import page_picture
from neuma_lib.data.demo_captures.sets import write_room
from workflow.stage import run_script

TEXELS = 112
"""Pixels of a square's side: corners of markers of 4 x 4 and 5 x 5 bits, at 0.75 of a square, lie between pixels."""


def main(inputs, output, params, run) -> None:
    demo = DemoCapturesConfig(**params.demo)
    board = demo.room.board
    texel = board.square / TEXELS
    page = page_picture(
        *black_rectangles(board), tuple(n * board.square for n in board.squares), PAPERS["A3"], texel
    )
    where = scenery(demo.room, page, (page.shape[1] * texel, page.shape[0] * texel))
    write_room(output.room, where, plates(demo, where, params.threads, run.progress))
    run.say(
        f"{np.prod(where.pictures[0].shape[:2]) / 1e6:.0f} million pixels of floor, {len(demo.cameras)} plates"
    )


run_script(main, snakemake)
