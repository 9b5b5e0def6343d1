"""PAC-NeRF's voxel radiance field: how well it shows held-out views, through particles and without, and what it costs.

    python -m benchmarks.radiance BouncyBall                                  # reads data/ and config/config.yaml
    python -m benchmarks.radiance random1_04 random1_01 --seeds 1 --count 8 --set '{"iterations": 600}'

A scene may be named by the beginning of its name. Its images must exist: `snakemake data/SCENE/static/transforms.json`.
Settings are to be tuned on draws that are not reported.
"""

import json
from pathlib import Path

import torch

from benchmarks.project_scenes import chosen_scenes, scene_parser
from benchmarks.timing import core_seconds
from neuma_lib.io.images import load_views
from neuma_lib.methods.pac_nerf.field_fit import fit_radiance_field
from neuma_lib.methods.pac_nerf.field_options import RadianceConfig
from neuma_lib.project.loading import merged

COLUMNS = "{:34} {:>6} {:>9} {:>7} {:>7} {:>7} {:>7} {:>7}"
HEADINGS = ("scene", "cores", "particles", "litres", "dB", "inside", "direct", "inside")


def main() -> None:
    parser = scene_parser(__doc__, nargs="+")
    parser.add_argument("--set", default="{}", help="changes of the settings of `radiance`, as JSON")
    args = parser.parse_args()
    torch.set_num_threads(1)
    print(COLUMNS.format(*HEADINGS))
    for name, settings in chosen_scenes(args).items():
        chosen = RadianceConfig(**merged(settings.radiance.plain(), json.loads(args.set)))
        views = load_views(Path(settings.data_root, name, "static/transforms.json"))
        before = core_seconds()
        field, report = fit_radiance_field(*views, chosen, settings.seed)
        seconds = core_seconds() - before
        particles = field.particles(chosen.spacing, chosen.min_opacity)
        numbers = (1e3 * float(particles.masses(1.0).sum()), report.psnr, report.psnr_object)
        numbers += (report.direct_psnr, report.direct_psnr_object)
        print(
            COLUMNS.format(name, round(seconds), report.particles, *(f"{value:.1f}" for value in numbers)),
            flush=True,
        )


if __name__ == "__main__":
    main()
