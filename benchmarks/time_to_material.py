"""Seconds from images to a law: where they go, from the files of a reconstructed scene to constants and a correction.

    python -m benchmarks.time_to_material BouncyBall --settings config/config.yaml config/paper.yaml

Dataset and reconstruction must exist (`snakemake results/SCENE/velocity.json`). Everything is done several times over
in one process: the first time includes what a process does once (CUDA's start, loading compiled kernels). Parts are
exclusive of each other, and the device is waited for at their ends. On a CPU its seconds are core seconds, which other
work beside it does not change.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import torch

from benchmarks.project_scenes import chosen_scenes, scene_parser, simulator
from benchmarks.timing import device_name, synchronize
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.device import choose_device
from neuma_lib.fitting import identify as identification
from neuma_lib.fitting import structured_fit
from neuma_lib.fitting.identify import identify
from neuma_lib.fitting.material import PixelLoss
from neuma_lib.fitting.structured_fit import rival_bases, train_structured
from neuma_lib.fitting.thrown_video import VideoResiduals
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.files import read_json, write_json
from neuma_lib.io.images import load_videos
from neuma_lib.io.mesh import read_mesh
from neuma_lib.io.particles import load_reconstruction
from neuma_lib.mechanics.structured import structured_law
from neuma_lib.project import cases
from neuma_lib.project.settings import Config

METHOD = "neuma_structured"
IDENTIFYING = {
    "simulating": (VideoResiduals, "_paths"),
    "rendering": (VideoResiduals, "_residual"),
    "linearising": (identification._Run, "linearise"),
    "uncertainties": (identification._Run, "_covariance"),
}
CORRECTING = {
    "training": (structured_fit, "train_material"),
    "judging": (structured_fit, "_simulated"),
}


class Clock:
    """Exclusive seconds of named parts, which may call each other, and how often each was entered."""

    def __init__(self, device: torch.device):
        self.seconds: Counter[str] = Counter()
        self.calls: Counter[str] = Counter()
        self._device, self._inner = device, [0.0]
        self._now = time.process_time if device.type == "cpu" else time.perf_counter

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        synchronize(self._device)
        started = self._now()
        self._inner.append(0.0)
        try:
            yield
        finally:
            synchronize(self._device)
            whole = self._now() - started
            self.seconds[name] += whole - self._inner.pop()
            self.calls[name] += 1
            self._inner[-1] += whole

    @contextmanager
    def parts(self, of: dict[str, tuple[Any, str]]) -> Iterator[None]:
        """Count calls of functions of classes or modules."""

        def counted(name, function):
            def call(*args, **options):
                with self.part(name):
                    return function(*args, **options)

            return call

        with ExitStack() as stack:
            for name, (owner, attribute) in of.items():
                function = getattr(owner, attribute)
                stack.callback(setattr, owner, attribute, function)
                setattr(owner, attribute, counted(name, function))
            yield

    def plain(self) -> dict[str, dict[str, float]]:
        return {name: {"seconds": s, "calls": self.calls[name]} for name, s in self.seconds.items()}


def run(name: str, settings: Config, device: torch.device) -> dict[str, Any]:
    """One scene, from its files to a structured law: plain numbers."""
    clock, scene, chosen = Clock(device), settings.scene(name), settings.identify
    data, results = Path(settings.data_root) / name, Path(settings.results_root) / name
    model, dt = simulator(settings, scene), scene.dt
    binding, exposure = settings.binding, {"dt": dt, "exposure_samples": settings.dataset.exposure_samples}
    with clock.part("reading body"):
        files = (results / file for file in ("particles.h5", "binding.h5", "gaussians.ply"))
        body = load_reconstruction(*files, scene.density, gaussian_motion=chosen.gaussian_motion).to(
            torch.float32, device
        )
        throw = InitialMotion.of(read_json(results / "velocity.json"))
    with clock.part("reading images"):
        videos = [
            video.to(torch.float32, device)
            for video in load_videos(data / "dynamic/transforms.json", chosen.views, **exposure)
        ]
    with clock.part("finer bodies"):
        mesh = read_mesh(results / "mesh.ply")
        finer = [
            body.resampled(
                torch.from_numpy(sample_volume(mesh, chosen.refined_particles, seed)),
                mesh.volume,
                scene.density,
                binding,
            )
            for seed in range(1, 1 + (chosen.resamplings if chosen.refined_particles else 0))
        ]
    stock = settings.priors.laws.get(scene.prior)
    with clock.parts(IDENTIFYING), clock.part("identifying, the rest"):
        found = identify(
            model, throw, body, videos, chosen, stock.plain() if stock else None, refined=[finer]
        )
    plain = found.as_dict()
    options = cases.case(settings, name, METHOD).options
    with clock.part("preparing the correction"):
        bases = [plain["law"], *rival_bases(plain, options.rivals)]
        laws = [
            structured_law({**base, "form": options.form}, dt, seed=options.seed).to(device) for base in bases
        ]
        for law in laws:
            law.attach_adaptor(options.rank, options.alpha, options.seed)
        start = found.best.motions[0].of_body(body)
        total = options.covariance_from == "total"
        loss = PixelLoss(body, videos, options.covariance_gradient, total=total, compare=options.compare)
    quiet = {"log": lambda text: None}
    with clock.parts(CORRECTING), clock.part("correcting, the rest"):
        trained, choice = train_structured(
            model, laws[0], start, loss, options, options, rivals=laws[1:], **quiet
        )
    parts = clock.plain()
    return {
        "parts": parts,
        "identifying": sum(parts[part]["seconds"] for part in (*IDENTIFYING, "identifying, the rest")),
        "correcting": sum(parts[part]["seconds"] for part in (*CORRECTING, "correcting, the rest")),
        "all": sum(part["seconds"] for part in parts.values()),
        "rollouts": found.rollouts,
        "rollouts of families": {family: fit.rollouts for family, fit in found.fits.items()},
        "found": found.summary(),
        "correction": choice.summary(),
        "loss": trained.best_loss,
    }


def main() -> None:
    parser = scene_parser(__doc__, "+")
    parser.add_argument("--repeat", type=int, default=2)
    parser.add_argument("--out", type=Path, help="also write the numbers there, as JSON")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows: dict[str, Any] = {}
    for name, settings in chosen_scenes(args).items():
        if name not in args.scenes:
            continue
        device = choose_device(settings.device)
        rows["device"] = device_name(device)
        rows[name] = []
        for _ in range(args.repeat):
            rows[name].append(run(name, settings, device))
            print(name, json.dumps(rows[name][-1], indent=1), flush=True)
            if args.out:
                write_json(args.out, rows)


if __name__ == "__main__":
    main()
