"""Fit the constants of a law to records of a clamped beam that is released."""

from dataclasses import asdict
from pathlib import Path

from neuma_lib.config.specimens import SpecimenConfig
from neuma_lib.evaluation.plotting.specimens import specimen_figure
from neuma_lib.evaluation.plotting.style import save
from neuma_lib.fitting.families import Family
from neuma_lib.fitting.specimen_fit import fit_specimen, numerical_damping, specimen_problem
from neuma_lib.io.files import write_json
from neuma_lib.io.markers import read_markers
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    settings = SpecimenConfig(**params.specimen)
    tracks = [read_markers(path, settings.markers) for path in inputs.records]
    problem = specimen_problem(settings, tracks, [Path(path).stem for path in inputs.records])
    options = {"fitted": settings.fitted, "duration": settings.duration, "log": run.log}
    fits = []
    for cells in settings.cells:
        run.log(f"{cells} cells along the height")
        fit = fit_specimen(*problem, cells=cells, **options)
        spec = fit.family.law_spec(fit.values)
        problem = problem[0], Family("specimen", spec), *problem[2:]  # the next grid starts there
        numerical = numerical_damping(problem[0], spec, cells, settings.duration)
        fits.append({"cells": cells, **fit.as_dict(), "without_viscosity": asdict(numerical)})
        run.log(f"the simulation itself has a damping ratio of {numerical.damping:.4f}")
    write_json(output.fit, {"fits": fits})
    save(specimen_figure(fit), output.figure)


run_script(main, snakemake)
