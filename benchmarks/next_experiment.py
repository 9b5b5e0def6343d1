"""Chosen next experiments against random ones: standard deviations and errors of the constants after joint fits.

    python -m benchmarks.next_experiment config/studies/next_experiment.yaml --jobs 64 --out chosen.json \
        --page docs/results/next_experiment.md

Materials, shapes and first launches are the random scenes of the settings, the last ``--outside`` of them of materials
outside the families. Videos are renders of the true body, filled with particles that have one Gaussian each. The
reconstruction has other and fewer particles and Gaussians, so that residuals are correlated errors of a reconstruction.
There is no Blender and no fit of Gaussians. The choice does not read the truth.

Tasks of a material run in parallel. A "ranking" is the first choice by the true family (of materials outside, by the
identified one). Each of its candidates is then done in a "fit", which fits this family to both videos: the chosen one,
the best in hindsight and the mean of the random launches are from these. In a "loop", all families are fitted to chosen
or random experiments one after the other, until all constants are determined. Results are written after each task, and
finished tasks are skipped.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from benchmarks.next_experiment_page import EXPERIMENTS, Material, Task, page
from benchmarks.timing import core_seconds, parser_of
from neuma_lib.config.blender import AppearanceConfig
from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.coupling.bodies import coloured_solid
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.data.blender.appearance import colors_at
from neuma_lib.device import choose_device
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.fitting.candidate_experiments import as_cameras, draw_starts, placed
from neuma_lib.fitting.choose_next import Option, Selection, choose_next, read_rivals
from neuma_lib.fitting.identified import FamilyFit, Identified
from neuma_lib.fitting.identify import identify
from neuma_lib.fitting.next_experiment import Experiment, stds, undetermined
from neuma_lib.geometry.shapes import place
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.files import read_json, write_json, write_text
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.combinations import constants_of, physical
from neuma_lib.project.loading import load, merged, read_yaml
from neuma_lib.project.settings import Config
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.colliders import Collider
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.observation import Observation
from neuma_lib.splatting.viewpoints import video_views

STD = np.array([0.01, 0.01, 0.03, 0.05, 0.05, 0.05])  # of the estimate of the initial motion [m/s, rad/s]
Video = tuple[InitialMotion, Reconstruction, Observation]
Settings = Mapping[str, Any]  # of an experiment, see `Option`


class Lab:
    """A hidden material and its object, which films experiments.

    Args:
        settings: with the random scenes.
        name: of a scene.
        device: of simulations and renders.
    """

    def __init__(self, settings: Config, name: str, device: torch.device | str = "cpu"):
        self.settings, self.scene, self.device = settings, settings.scene(name), device
        number = list(settings.random_scenes).index(name)
        self.random = np.random.default_rng([settings.random.seed, number])
        simulation = settings.simulation
        self.model = MPM(
            simulation.grid, self.scene.dt, simulation.gravity, simulation.boundary, simulation.contact
        )
        self.law = self.scene.plain()["law"]
        self.family = settings.random.family(name)
        self.truth = self._solid(settings.dataset.particles, 1000)
        self.body = self._solid(settings.geometry.particles, 1)
        self.first = self.film(
            self.model, self.truth, self.body, self.scene.velocity, self.scene.spin, self.scene.steps
        )

    def _solid(self, count: int, seed: int) -> Reconstruction:
        """The object, filled with particles."""
        scene = self.scene
        mesh = place(scene.shape, scene.size, scene.height, scene.center)
        x0 = sample_volume(mesh, count, seed=seed)
        colors = torch.from_numpy(colors_at(mesh, x0, AppearanceConfig(**scene.plain()["appearance"])))
        body = coloured_solid(mesh, torch.as_tensor(x0, dtype=torch.float32), 1000.0, colors)
        return replace(body.to(torch.float32, self.device), affine=False)

    @torch.no_grad()
    def film(
        self,
        model: MPM,
        truth: Reconstruction,
        body: Reconstruction,
        velocity: Sequence[float],
        spin: Sequence[float],
        steps: int,
    ) -> Video:
        """An estimate of the initial motion, the reconstruction at the start, and the video."""
        count, pixels = self.settings.dataset.frames, self.settings.dataset.dynamic.width
        frames = tuple(round(k * steps / (count - 1)) for k in range(count))
        law, start = analytic_law(self.law, model.dt).to(self.device), truth.state(velocity, spin)
        path = rollout(model, law, start, steps=steps, frames=frames, total=True)
        like = Cameras(torch.eye(4)[None], torch.eye(3)[None], pixels, pixels).to(self.device)
        cameras = as_cameras(video_views(path.x.flatten(0, 1).cpu().numpy(), 1, pixels, pixels), like)
        images = truth.particle_gs(cameras)(path.x, path.stretch)
        axes = cameras.viewmats[0, :3, :3].double().cpu().numpy()
        centre = (body.mass @ body.x0 / body.mass.sum()).double().cpu().numpy()
        std = np.zeros(6) if model.clamps else STD
        exact = InitialMotion(np.array(velocity), np.array(spin), centre, axes, std)
        return exact.moved(self.random.standard_normal(6)), body, Observation(frames, images, cameras)

    def model_of(self, own: Settings) -> MPM:
        """The simulator with the platen or the clamp of an experiment."""
        colliders = [Collider(**each) for each in own.get("colliders", ())]
        clamps = [Clamp(**each) for each in own.get("clamps", ())]
        return replace(
            self.model, colliders=(*self.model.colliders, *colliders), clamps=(*self.model.clamps, *clamps)
        )

    def repeat(self, own: Settings) -> Video:
        """Do an experiment that was chosen or drawn."""
        R = Rotation.from_rotvec(own.get("rotation", (0.0, 0.0, 0.0))).as_matrix()
        centre = (own["center"][0], own["height"], own["center"][1])
        at = [placed(each, R, centre) for each in (self.truth, self.body)]
        return self.film(self.model_of(own), *at, own["velocity"], own["spin"], own["steps"])

    def random_launch(self) -> Settings:
        seed, lab = int(self.random.integers(2**31)), self.settings.next
        (start,) = draw_starts(self.model, self.body, self.first[0], self.scene.steps, lab, 1, seed)
        return start.settings

    def fitted(
        self,
        experiments: Sequence[Settings],
        families: Sequence[str],
        start: Mapping[str, Any] | None = None,
    ) -> Identified:
        """What is identified in the first launch and some other experiments, also from the law that was identified
        before."""
        models = [self.model, *map(self.model_of, experiments)]
        videos = [self.repeat(own) for own in experiments]
        return identify(models, *self.first, self.chosen(families), start, other_videos=videos)

    def chosen(self, families: Sequence[str]) -> IdentifyConfig:
        known = self.settings.identify
        own = {name: known.families[name] for name in families}
        return known.model_copy(update={"families": own, "refined_particles": 0})

    def selection(self, result: Identified, options: Sequence[Option], seed: int) -> Selection:
        """Ranked candidates after some experiments."""
        models = [self.model, *(option.experiment.model for option in options)]
        bodies = [self.body, *(option.experiment.body for option in options)]
        videos = [[self.first[2]], *(option.experiment.video for option in options)]
        parts = zip(models, result.best.motions, bodies, videos, strict=True)
        stds = [self.first[0].std, *(option.experiment.motion.std for option in options)]
        filmed = [
            Experiment(model, replace(motion, std=std), body, video)
            for (model, motion, body, video), std in zip(parts, stds, strict=True)
        ]
        rivals = read_rivals(result.as_dict(), result.settings, result.best, len(result.ties))
        lab, ties = self.settings.next, bool(result.ties)
        return choose_next(result.best, filmed, result.settings, lab, rivals=rivals, ties=ties, seed=seed)

    def summary(self, fit: FamilyFit) -> dict[str, Any]:
        """Standard deviations, and logarithms of the ratios to the true constants where there are such."""
        truth, values = physical(constants_of(self.law)), physical(fit.values)
        errors = {key: math.log(values[key] / truth[key]) for key in values.keys() & truth.keys()}
        return {"family": fit.family.name, "std": stds(fit, self.settings.identify), "error": errors}


def law_of(result: Identified) -> dict[str, Any]:
    return dict(result.best.family.law_spec(result.best.values))


def run(
    settings: Config, task: Task, known: Mapping[str, Any] | None, experiments: int, device: torch.device
) -> dict[str, Any]:
    """The result of a task in plain values.

    Args:
        known: result of the ranking of the material, for a fit.
        experiments: at most of a loop, with the first one.
        device: of simulations and renders.
    """
    torch.set_num_threads(1)
    lab = Lab(settings, task.scene, device)
    every = list(settings.identify.families)
    try:
        if task.kind == "fit":
            return fit(lab, task.number, known)
        if task.kind == "loop":
            return loop(lab, bool(task.number), every, experiments)
        return ranking(lab, every)
    except (InputError, NonFiniteError) as error:
        return {"refused": str(error)}


def ranking(lab: Lab, every: Sequence[str]) -> dict[str, Any]:
    """The first choice."""
    family = lab.family if lab.family in every else lab.fitted([], every).best.family.name
    alone = lab.fitted([], [family])
    started = core_seconds()
    selection = lab.selection(alone, [], lab.settings.random.seed)
    options = [
        {
            "kind": option.kind,
            "settings": option.settings,
            "predicted": stds(option.forecast.fit, alone.settings),
        }
        for option in selection.options
    ]
    seconds = core_seconds() - started
    return {"alone": lab.summary(alone.best), "law": law_of(alone), "seconds": seconds, "options": options}


def fit(lab: Lab, rank: int, known: Mapping[str, Any]) -> dict[str, Any]:
    """The joint fit of a candidate, with its own errors of the estimate of the initial motion."""
    lab.random.standard_normal(6 * rank)
    own = known["options"][rank]
    joint = lab.fitted([own["settings"]], [known["alone"]["family"]], known["law"])
    return {"rank": rank, "kind": own["kind"], "predicted": own["predicted"], **lab.summary(joint.best)}


def loop(lab: Lab, choose: bool, every: Sequence[str], most: int) -> dict[str, Any]:
    """Experiments until all constants are determined, chosen ones or random launches."""
    options: list[Option] = []
    experiments: list[Settings] = []
    rounds, law = [], None
    while True:
        result = lab.fitted(experiments, every, law)
        law = law_of(result)
        kinds = [option.kind for option in options] or ["launch"] * len(experiments)
        rounds.append({**lab.summary(result.best), "ties": result.ties, "kinds": kinds})
        known = not undetermined(result.best, result.settings)
        if len(rounds) == most or known and (experiments or not result.ties):
            return {"rounds": rounds}
        if choose:
            seed = lab.settings.random.seed + len(experiments)
            options.append(lab.selection(result, options, seed).options[0])
            experiments.append(options[-1].settings)
        else:
            experiments.append(lab.random_launch())


def tasks_of(names: Sequence[str], results: Mapping[str, Mapping[str, Any]]) -> Iterator[Task]:
    """All tasks that are possible after those with results: rankings and loops first, then the fits of the best
    candidate of each kind and of launches."""
    yield from (Task(name, "ranking", 0) for name in names)
    yield from (Task(name, "loop", number) for number in (1, 0) for name in names)
    fits = []
    for name in names:
        seen = set[str]()
        for rank, option in enumerate(results.get(str(Task(name, "ranking", 0)), {}).get("options", ())):
            fits.append((rank > 0 and option["kind"] in seen - {"launch"}, rank, Task(name, "fit", rank)))
            seen.add(option["kind"])
    yield from (task for *_, task in sorted(fits, key=lambda each: each[:2]))


def drawn(files: Sequence[Path], outside: int) -> dict[str, Config]:
    """Settings of each material, of which the last ones are outside the families."""
    raw = read_yaml("config/config.yaml")
    for file in files:
        raw = merged(raw, read_yaml(file))
    inside, others = (load(merged(raw, {"random": {"draw_from": each}})) for each in ("families", "outside"))
    names = list(inside.random_scenes)
    return {name: inside for name in names[: len(names) - outside]} | {
        name: others for name in list(others.random_scenes)[:outside]
    }


def finished(
    jobs: int,
    device: torch.device,
    settings: Mapping[str, Config],
    kinds: Sequence[str],
    results: dict[str, dict[str, Any]],
) -> Iterator[str]:
    """Add the missing results of some kinds of tasks as they finish, and yield the names of the tasks."""
    running: dict[Future[dict[str, Any]], str] = {}
    with ProcessPoolExecutor(jobs, get_context("spawn")) as processes:
        while True:
            for task in tasks_of(list(settings), results):
                key = str(task)
                if (
                    len(running) >= jobs
                    or task.kind not in kinds
                    or key in results
                    or key in running.values()
                ):
                    continue
                known = results.get(str(Task(task.scene, "ranking", 0)))
                own = processes.submit(run, settings[task.scene], task, known, EXPERIMENTS, device)
                running[own] = key
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                key = running.pop(future)
                results[key] = future.result()
                yield key


def main(arguments: Sequence[str] | None = None) -> None:
    parser = parser_of(__doc__)
    parser.add_argument("files", type=Path, nargs="*", help="settings on top of config/config.yaml")
    parser.add_argument("--outside", type=int, default=3, help="materials outside the families")
    parser.add_argument("--jobs", type=int, default=1, help="parallel processes of one thread")
    parser.add_argument("--device", default="cpu", help="of simulations and renders")
    parser.add_argument("--kinds", nargs="+", default=["ranking", "loop", "fit"], help="kinds of tasks")
    parser.add_argument("--out", type=Path, required=True, help="results, which a later run continues")
    parser.add_argument("--page", type=Path, help="Markdown page to write")
    options = parser.parse_args(arguments)
    settings = drawn(options.files, options.outside)
    results: dict[str, Any] = read_json(options.out) if options.out.is_file() else {}
    for key in finished(options.jobs, choose_device(options.device), settings, options.kinds, results):
        write_json(options.out, results)
        print(key, flush=True)
    by_task = {task: results[str(task)] for task in tasks_of(list(settings), results) if str(task) in results}
    materials = [Material.of(name, own, by_task) for name, own in settings.items()]
    files = " ".join(map(str, options.files))
    text = page(
        materials,
        f"python -m benchmarks.next_experiment {files} --outside {options.outside} --out {options.out}",
    )
    if options.page:
        write_text(options.page, text)
    print(text)


if __name__ == "__main__":
    main()
