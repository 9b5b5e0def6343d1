"""Identified constants and the motions that they predict elsewhere, next to those of the true law."""

from dataclasses import replace

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.data.ground_truth import PER_CELL
from neuma_lib.device import choose_device
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.evaluation.motion_spread import Resolution, other_motions, predict_with_spread, steps_at
from neuma_lib.fitting.families import FRICTION
from neuma_lib.fitting.video_residuals import finer
from neuma_lib.io.files import one_line, read_json, write_json
from neuma_lib.io.simulator import simulator
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.paper.calibration_record import constants_with_truths, families_with_truth, motion_with_truth
from workflow.stage import run_script

FRAMES, POINTS = 12, 40


def main(inputs, output, params, run) -> None:
    identified, scene, truth = read_json(inputs.identified), params.scene, params.truth
    settings, device = IdentifyConfig(**params.identify), choose_device(params.device)
    model, law = simulator(params.simulation), params.scene["law"]
    converged = truth["grid"] > model.grid
    frames = [round(n * params.steps / FRAMES) for n in range(1, FRAMES + 1)]
    times = [n * model.dt for n in frames]
    coarse = Resolution(model, params.particles)
    fine = Resolution(
        finer(model, settings.refinement, frames) if converged else model,
        settings.refined_particles or 4 * params.particles,
    )
    true_model = replace(model, grid=truth["grid"], dt=truth["dt"])
    boundary = params.simulation["boundary"]
    friction = boundary if isinstance(boundary, int | float) else None
    record = {
        "name": params.name,
        "seed": params.random_seed,
        "development": params.development,
        "converged": converged,
        "constants": constants_with_truths(identified, law, friction, converged),
        "families": families_with_truth(identified, law),
        "motions": {},
        "failed": {},
    }
    lowest = identified.get(FRICTION, {}).get("at_least")
    record["at_least"] = None if lowest is None or friction is None else [lowest, friction]
    of = "material" if converged else "best"
    for key, launch in other_motions(scene).items():
        if of not in identified:
            record["failed"][key] = "no constants of the material"
            continue
        try:
            motion = predict_with_spread(
                identified, of, launch, (coarse, fine), times, POINTS, settings.model_std, params.seed, device
            )
        except (InputError, NonFiniteError) as error:
            record["failed"][key] = one_line(str(error))
            continue
        particles = truth["particles"] or round(PER_CELL * launch.mesh.volume * true_model.grid**3)
        true_law = analytic_law(law, true_model.dt)
        path = Resolution(true_model, particles).path(
            launch, true_law, steps_at(true_model, times), motion.points.to(device), params.truth_seed
        )
        record["motions"][key] = motion_with_truth(motion, path[motion.first :].cpu())
        run.log(
            f"{key}: root mean square error {1e3 * _rms(motion.value - path[motion.first :].cpu()):.1f} mm"
        )
    write_json(output.record, record)
    run.log(f"{len(record['constants'])} constants, {len(record['motions'])} motions")


def _rms(difference) -> float:
    return float(difference.square().sum(-1).mean().sqrt())


run_script(main, snakemake)
