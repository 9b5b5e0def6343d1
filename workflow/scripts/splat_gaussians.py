"""Read a splat, leave out what is not the object, thin it, and put it where it starts."""

from dataclasses import asdict

from neuma_lib.config.splats import SplatConfig
from neuma_lib.io.files import write_json
from neuma_lib.io.gaussians import save_gaussians
from neuma_lib.io.splats import load_splat
from neuma_lib.splatting.culling import culled, placed, turned, upright
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    settings = SplatConfig(**params.splat)
    rules = ("min_opacity", "max_scale", "reach", "min_links", "count")
    chosen = {name: getattr(settings, name) for name in rules}
    gaussians, counts = culled(load_splat(inputs.splat), **chosen, seed=params.seed)
    gaussians = placed(turned(gaussians, upright(settings.up, settings.turn)), **params.place)
    save_gaussians(output.gaussians, gaussians)
    write_json(output.report, asdict(counts))
    run.log(
        f"{counts.read} Gaussians: {counts.faint} faint, {counts.oversized} oversized, {counts.isolated} isolated, "
        f"{counts.kept} kept of the others"
    )


run_script(main, snakemake)
