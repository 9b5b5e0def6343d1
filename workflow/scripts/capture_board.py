"""Print the board for the floor at its true size."""

from neuma_lib.capture.calibration.board import print_board
from neuma_lib.config.capture import BoardConfig
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    board = BoardConfig(**params.board)
    print_board(output.board, board, params.paper)
    columns, rows = board.squares
    run.log(
        f"{columns} x {rows} squares of {1000 * board.square:.1f} mm on {params.paper}: print it at 100 %, measure the"
        " side of a square, and set it as board.square in capture.yaml"
    )


run_script(main, snakemake)
