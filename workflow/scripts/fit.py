"""Fit a method to a scene."""

from neuma_lib.methods.base import Problem, method_of
from workflow.motion import FitStage, files_of
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    method = method_of(params.method["module"])
    problem = Problem(params.simulation, params.densities, params.exposure, params.seed)
    stage = FitStage(output.product, output.history, params.checkpoint, params.device, params.code, run)
    method.fit(files_of(inputs, params.method["files"]), params.method["options"], problem, stage)


run_script(main, snakemake)
