"""PAC-NeRF with a known family: constants from a video of a body that follows that family.

    python -m benchmarks.pac_nerf                                   # all families of config/config.yaml; a few minutes
    python -m benchmarks.pac_nerf elastic sand --set '{"iterations_all": 100}'

The body is a given radiance field of a spotted ball, so that only the later stages are evaluated. It falls on the
floor, is simulated with more particles than in the fit, and rendered with the same rays. The fit starts from the
family's published guess, with a modulus, yield stress or viscosity wrong by a decade. Every family has at least one
bound, see `BOUNDS`. The other constants are printed.
"""

import json
from collections.abc import Mapping
from typing import Any

import torch

from benchmarks.timing import core_seconds, parser_of
from neuma_lib.evaluation.text_tables import as_markdown
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.methods.pac_nerf.carried_field import CarriedField
from neuma_lib.methods.pac_nerf.families import FamilyConstants
from neuma_lib.methods.pac_nerf.field import FieldParticles, RadianceField
from neuma_lib.methods.pac_nerf.fit import PacNerfFit, fit_pac_nerf
from neuma_lib.methods.pac_nerf.lattice import Lattice
from neuma_lib.methods.pac_nerf.options import PacFamilyConfig, PacNerfConfig
from neuma_lib.methods.pac_nerf.rendering import Opacity, camera_rays
from neuma_lib.project.loading import load, merged, read_yaml
from neuma_lib.sim.model import MPM, contact_clearance
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from neuma_lib.splatting.cameras import Cameras, look_at
from neuma_lib.splatting.observation import Observation

MODEL = MPM(grid=16, dt=1e-3)
V0 = (0.3, -1.5, 0.2)
DENSITY = 1000.0
CENTRE, RADIUS, EDGE = (0.5, 0.25, 0.5), 0.08, 0.025
"""Of the ball, and how wide its edge is [m]."""
VOXEL, NODES = 0.025, 17
MIN_OPACITY = 1e-3
TRUTH_SPACING = 0.75  # side of a cell that holds one particle of the truth [voxels]; 1 in the fit
STEPS, STEPS_A_FRAME = 200, 8
PIXELS = 32
SMALL = {"particles": 400, "followed": 8}  # settings that a small body changes
TRUTHS: dict[str, dict[str, float]] = {
    "elastic": {"E": 3.16e4, "nu": 0.35},
    "plasticine": {"E": 1e5, "nu": 0.35, "yield_stress": 5e3},
    "sand": {"friction_angle": 35.0},
    "non_newtonian": {"mu": 1e4, "kappa": 3e5, "yield_stress": 1e3, "viscosity": 5.0},
    "newtonian": {"kappa": 2e5, "viscosity": 50.0},
}
BOUNDS: dict[str, dict[str, float]] = {
    "elastic": {"E": 0.1, "nu": 0.05},
    "plasticine": {"yield_stress": 0.15},
    "sand": {"friction_angle": 3.0},
    "non_newtonian": {"yield_stress": 0.15},
    "newtonian": {"viscosity": 0.25},  # 0.23, with the contact of particles that are smaller in the truth
}
"""Largest errors: relative, but in nu and in the angle [degrees]."""


def spotted_ball(dtype: torch.dtype = torch.float32) -> RadianceField:
    """A field of a ball with large spots and, as fitted ones have, a soft edge.

    A sharp one would hide the silhouette from the gradient: nodes at the border take the density of what is near,
    however small its weight, so that they change when they get or lose a particle and not in between.
    """
    torch.manual_seed(0)
    corner = tuple(c - (NODES - 1) * VOXEL / 2 for c in CENTRE)
    field = RadianceField(Lattice(corner, VOXEL, (NODES,) * 3), Opacity(1e-4, 0.1)).double()
    points = field.lattice.points(field.density).double() - torch.tensor(CENTRE).double()
    radius = points.norm(dim=-1, keepdim=True)
    field.density.data = (20 - (radius - RADIUS) / EDGE * 12).clamp(-30, 20)
    waves = 30 * torch.randn(3, 12, dtype=torch.float64) / 3**0.5
    field.features.data = 2 * torch.sin(points @ waves + torch.randn(12, dtype=torch.float64))
    return field.to(dtype).requires_grad_(False)


def cameras(size: int = PIXELS, dtype: torch.dtype = torch.float32) -> Cameras:
    """Three around the place where the ball hits the floor."""
    eyes = torch.tensor([[0.5, 0.4, 1.5], [1.4, 0.5, 0.3], [-0.3, 0.5, 0.2]])
    K = torch.tensor([[1.6 * size, 0, size / 2], [0, 1.6 * size, size / 2], [0, 0, 1.0]])
    poses = look_at(eyes, torch.tensor([0.5, 0.17, 0.5]), torch.tensor([0.0, 1.0, 0.0]))
    return Cameras(poses, K.expand(3, 3, 3).contiguous(), size, size).to(dtype=dtype)


@torch.no_grad()
def film(
    field: RadianceField,
    body: FieldParticles,
    spec: Mapping[str, Any],
    frames: tuple[int, ...],
    view: Cameras,
) -> Observation:
    """The video of a field whose particles all follow a law, launched with `V0`."""
    velocity = torch.tensor(V0).to(body.x)
    start = State(body.x, velocity, body.masses(DENSITY), body.volumes())
    path = rollout(MODEL, analytic_law(spec, dt=MODEL.dt), start, steps=frames[-1], frames=frames)
    pictures = [
        field.render(*body.seen(x), *camera_rays(view, k))[0] for x in path.x for k in range(len(view))
    ]
    images = torch.stack(pictures).view(len(frames), len(view), view.height, view.width, 3)
    return Observation(frames, images, view)


def contact(particles: FieldParticles, frames: tuple[int, ...]) -> int:
    """Step of the last frame before the particles, launched with `V0`, touch the floor."""
    low = float(contact_clearance(MODEL, particles.x, torch.full((1,), particles.volume)))
    fall = [V0[1] * n * MODEL.dt + MODEL.gravity[1] / 2 * (n * MODEL.dt) ** 2 for n in frames]
    return max(n for n, y in zip(frames, fall, strict=True) if low + y > 0)


def specification(family: PacFamilyConfig, values: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    """The law of a family with other values of what is fitted in it."""
    constants = FamilyConstants(family)
    known = constants.fitted_numbers() | dict(values)
    if "kappa" in known:
        mu, kappa = known.get("mu", constants.fixed["mu"]), known["kappa"]
        known["E"] = 9 * kappa * mu / (3 * kappa + mu)
        known["nu"] = (3 * kappa - 2 * mu) / (2 * (3 * kappa + mu))
    return FamilyConstants(family, known).specification()


def recover(name: str, family: PacFamilyConfig, settings: PacNerfConfig, log=print) -> PacNerfFit:
    """Fit a family to the video of its truth, from its published guess."""
    field = spotted_ball()
    truth = field.particles(TRUTH_SPACING, MIN_OPACITY)
    frames = tuple(range(0, STEPS + 1, STEPS_A_FRAME))
    video = film(field, truth, specification(family, TRUTHS[name]), frames, cameras())
    body = CarriedField(field, 1.0, MIN_OPACITY, settings, DENSITY)
    return fit_pac_nerf(
        MODEL, body, video, contact(truth, frames), FamilyConstants(family), settings, log=log
    )


def error(name: str, truth: float, value: float) -> float:
    """Of a constant, as `BOUNDS` has it."""
    return abs(value - truth) / (1.0 if name in ("nu", "friction_angle") else truth)


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("families", nargs="*", default=list(TRUTHS), help="names")
    parser.add_argument("--settings", default="config/config.yaml", help="YAML file")
    parser.add_argument("--set", default="{}", help="changes of the settings of `pac_nerf`, as JSON")
    args = parser.parse_args()
    if unknown := set(args.families) - set(TRUTHS):
        parser.error(f"there is no truth for {', '.join(unknown)}; choose from {', '.join(TRUTHS)}")
    torch.set_num_threads(1)
    plain = load(read_yaml(args.settings)).pac_nerf.plain()
    settings = PacNerfConfig(**merged(plain, SMALL | json.loads(args.set)))
    rows = []
    for name in args.families:
        before = core_seconds()
        fit = recover(name, settings.families[name], settings, lambda line: None)
        seconds = core_seconds() - before
        guess = FamilyConstants(settings.families[name]).fitted_numbers()
        for key, value in fit.constants.fitted_numbers().items():
            off, bound = error(key, TRUTHS[name][key], value), BOUNDS[name].get(key)
            numbers = [f"{number:.4g}" for number in (guess[key], TRUTHS[name][key], value)]
            rows.append([name, key, *numbers, f"{off:.3f}", bound or "", round(seconds)])
        print(name, fit.summary(), flush=True)
    print(
        *as_markdown(["family", "constant", "guess", "truth", "found", "error", "bound", "core s"], rows),
        sep="\n",
    )


if __name__ == "__main__":
    main()
