"""Core seconds of a finer body as identification makes it: particles in a mesh, and Gaussians bound to them.

    python -m benchmarks.finer_bodies BouncyBall ClayCat --gaussians 20000

The reconstruction must exist. With another count of Gaussians than it has, they are drawn from its own, each shifted at
random by its own covariance and smaller by what keeps their area together.
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.project_scenes import chosen_scenes, scene_parser
from benchmarks.timing import seconds
from neuma_lib.coupling.particle_binding import bind_two_pass
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.gaussians import load_gaussians
from neuma_lib.io.mesh import read_mesh


def drawn(means: Tensor, covars: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """That many Gaussians (count, 3), (count, 3, 3) like those given."""
    generator = torch.Generator().manual_seed(0)
    pick = torch.randint(len(means), (count,), generator=generator)
    values, axes = torch.linalg.eigh(covars[pick].double())
    noise = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    shift = (axes * values.clamp(min=0).sqrt()[:, None] @ noise[:, :, None])[..., 0]
    return (means[pick] + shift).to(means), covars[pick] * (len(means) / count)


def main() -> None:
    parser = scene_parser(__doc__, "+")
    parser.add_argument("--particles", type=int, default=120_000)
    parser.add_argument("--gaussians", type=int, default=20_000, help="0: those of the reconstruction")
    parser.add_argument("--repeat", type=int, default=5)
    args = parser.parse_args()
    torch.set_num_threads(1)
    for name, settings in chosen_scenes(args).items():
        if name not in args.scenes:
            continue
        results = Path(settings.results_root) / name
        mesh, gaussians = read_mesh(results / "mesh.ply"), load_gaussians(results / "gaussians.ply")
        means, covars = gaussians.means, gaussians.covars()
        if args.gaussians:
            means, covars = drawn(means, covars, args.gaussians)
        filling = mesh, args.particles, 1
        x = torch.from_numpy(sample_volume(*filling))
        bound = means, covars, x, float(mesh.volume), settings.binding
        binding, _, added, _ = bind_two_pass(*bound)
        sampling, binds = (
            seconds(work, torch.device("cpu"), args.repeat, time.process_time)
            for work in (partial(sample_volume, *filling), partial(bind_two_pass, *bound))
        )
        print(
            f"{name}: {len(mesh.faces)} faces, {len(x)} particles {sampling:.3f} s; {len(means)} Gaussians, "
            f"{added} particles added, {len(binding.indices)} pairs {binds:.3f} s"
        )


if __name__ == "__main__":
    main()
