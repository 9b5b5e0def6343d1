"""Seconds from images to a law by part: from the files of a reconstructed scene to constants and a correction.

    python -m benchmarks.time_to_material BouncyBall --settings config/config.yaml config/paper.yaml

Dataset and reconstruction must exist (`snakemake results/SCENE/velocity.json`). Everything is repeated in one
process: the first time includes work that a process does once (start of CUDA, loading of compiled kernels). Parts
exclude each other and end when the device is idle. On a CPU they are core seconds, which hardly depend on other load.
"""

import json
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import torch

from benchmarks.project_scenes import (
    chosen_scenes,
    prior_of,
    read_body,
    refined_bodies,
    scene_parser,
    simulator,
)
from benchmarks.timing import device_name, synchronize
from neuma_lib.device import choose_device
from neuma_lib.fitting import structured_fit
from neuma_lib.fitting.family_run import FamilyRun
from neuma_lib.fitting.identify import identify
from neuma_lib.fitting.material import PixelLoss
from neuma_lib.fitting.structured_fit import rival_bases, train_structured
from neuma_lib.fitting.video_residuals import VideoResiduals
from neuma_lib.io.files import write_json
from neuma_lib.io.images import load_videos
from neuma_lib.mechanics.structured import structured_law
from neuma_lib.project import cases
from neuma_lib.project.settings import Config

METHOD = "neuma_structured"
IDENTIFYING = {
    "simulating": (VideoResiduals, "_paths"),
    "rendering": (VideoResiduals, "_residual"),
    "linearising": (FamilyRun, "linearise"),
    "uncertainties": (FamilyRun, "_covariance"),
}
CORRECTING = {"training": (structured_fit, "train_material"), "scoring": (structured_fit, "_simulate")}


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
    clock, scene, chosen = Clock(device), settings.scene(name), settings.identify_of(name)
    model, dt = simulator(settings, scene), scene.dt
    exposure = {"dt": dt, "exposure_samples": settings.dataset.exposure_samples}
    with clock.part("reading body"):
        body, motion = read_body(name, settings, chosen, device)
    transforms = Path(settings.data_root) / name / "dynamic/transforms.json"
    with clock.part("reading images"):
        videos = [
            video.to(torch.float32, device) for video in load_videos(transforms, chosen.views, **exposure)
        ]
    with clock.part("refined bodies"):
        refined = refined_bodies(name, settings, chosen, body)
    prior = prior_of(settings, scene)
    with clock.parts(IDENTIFYING), clock.part("identifying, the rest"):
        identified = identify(model, motion, body, videos, chosen, prior, refined=refined)
    plain = identified.as_dict()
    options = cases.case(settings, name, METHOD).options
    with clock.part("preparing the correction"):
        bases = [plain["law"], *rival_bases(plain, options.rivals)]
        laws = [
            structured_law({**base, "form": options.form}, dt, seed=options.seed).to(device) for base in bases
        ]
        for law in laws:
            law.attach_adaptor(options.rank, options.alpha, options.seed)
        start = identified.best.motions[0].of_body(body)
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
        "rollouts": identified.rollouts,
        "rollouts of families": {family: fit.rollouts for family, fit in identified.fits.items()},
        "found": identified.summary(),
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
