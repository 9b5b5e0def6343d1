"""The room of the demo captures: textures of floor, walls and page, and the empty scene in each video camera."""

import numpy as np

from neuma_lib.capture.calibration.board import black_rectangles
from neuma_lib.config.board import PAPERS
from studies.capture_benchmark.filming import backgrounds, scenery
from studies.capture_benchmark.pictures import page_picture
from studies.capture_benchmark.sets import write_room
from studies.capture_benchmark.settings import DemoCapturesConfig
from workflow.stage import run_script

TEXELS = 112
"""Pixels of a square's side, such that edges of marker bits lie on edges of pixels for markers of 4 x 4 and 5 x 5 bits
and 0.75 of a square."""


def main(inputs, output, params, run) -> None:
    demo = DemoCapturesConfig(**params.demo)
    board = demo.room.board
    texel = board.square / TEXELS
    page = page_picture(
        *black_rectangles(board), tuple(n * board.square for n in board.squares), PAPERS["A3"], texel
    )
    size = page.shape[1] * texel, page.shape[0] * texel
    where = scenery(demo.room, page, size, demo.objects[params.name])
    write_room(output.room, where, backgrounds(demo, where, params.threads, run.progress))
    pixels = np.prod(where.pictures[0].shape[:2])
    run.log(f"floor of {pixels / 1e6:.0f} million pixels, backgrounds of {len(demo.cameras)} cameras")


run_script(main, snakemake)
