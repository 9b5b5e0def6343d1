"""Rank what to film next."""

from dataclasses import replace
from pathlib import Path

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.next import NextConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.device import choose_device
from neuma_lib.evaluation.next_page import SHOWN, describe, draw, page
from neuma_lib.fitting.choose_next import choose_next, read_fit, read_rivals
from neuma_lib.fitting.identified import recorded_friction
from neuma_lib.fitting.next_experiment import Experiment, motion_derivatives
from neuma_lib.io.files import read_json, write_json, write_text
from neuma_lib.io.particles import load_initial_state
from neuma_lib.io.simulator import simulator
from neuma_lib.threads import use_threads
from workflow.motion import filmed_bodies, simulators
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    use_threads(snakemake.threads)
    settings, lab = IdentifyConfig(**params.identify), NextConfig(**params.next)
    # Limits and pages are in metres of the room, simulations in those of the box.
    lab = lab.model_copy(
        update={key: params.scale * getattr(lab, key) for key in ("max_height", "max_speed")}
    )
    device, record = choose_device(params.device), read_json(inputs.identified)
    fit, models = read_fit(record, settings), simulators(params)
    if (friction := recorded_friction(record)) is not None:
        models = [model.with_friction(friction) for model in models]
    starts = [record, *record.get("further_videos", [])]
    experiments = [
        Experiment(model, replace(InitialMotion.of(start["start"]), std=motion.std), body, video)
        for model, start, (motion, body, video) in zip(
            models, starts, filmed_bodies(inputs, params, settings, device), strict=True
        )
    ]
    derivatives = None
    if params.predicted:
        own = params.predicted
        state, _ = load_initial_state(*inputs.predicted, [own["density"]])
        derivatives = motion_derivatives(
            fit, simulator(own["simulation"]), state.to(device), own["frames"], settings
        )
    choice = choose_next(
        fit,
        experiments,
        settings,
        lab,
        rivals=read_rivals(record, settings, fit, max(lab.rivals, len(record["ties"]))),
        ties=bool(record["ties"]),
        derivatives=derivatives,
        reframe=params.rendered,
        seed=params.seed,
        progress=run.progress,
        log=run.log,
    )
    written, folder = choice.as_dict(params.scale), Path(output.page).parent
    draw(output.picture, [(option.experiment, option.path) for option in choice.options[:SHOWN]])
    write_json(output.record, written)
    write_text(output.page, page(written, Path(output.picture).name, folder.as_posix()))
    run.log(f"next: {describe(written['candidates'][0])}. All candidates: {output.page}")


run_script(main, snakemake)
