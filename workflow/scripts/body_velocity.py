"""The initial motion of one of several bodies."""

from neuma_lib.io.files import read_json, write_json
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    motion = read_json(inputs.motions)["bodies"][params.bodies.index(params.body)]
    write_json(output.velocity, motion)
    run.log(f"velocity {motion['v0']} m/s")


run_script(main, snakemake)
