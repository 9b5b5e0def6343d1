"""Find the family and the constants of the material in one video or several."""

import torch

from neuma_lib.config.binding import BindingConfig
from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.device import choose_device
from neuma_lib.fitting.identify import identify
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.files import listed, write_json
from neuma_lib.io.mesh import read_mesh
from neuma_lib.threads import use_threads
from workflow.motion import filmed_bodies, simulators
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    use_threads(snakemake.threads)
    settings, binding = IdentifyConfig(**params.identify), BindingConfig(**params.binding)
    device = choose_device(params.device)
    videos = filmed_bodies(inputs, params, settings, device)
    refined = []
    for (_, body, _), file, density in zip(videos, listed(inputs.mesh), params.densities, strict=True):
        if settings.refined_particles:
            mesh = read_mesh(file)
            x = torch.from_numpy(sample_volume(mesh, settings.refined_particles, params.seed + 1))
            refined.append(body.resampled(x, mesh.volume, density, binding))
    identification = identify(
        simulators(params),
        *videos[0],
        settings,
        params.published,
        refined=refined,
        other_videos=videos[1:],
        progress=run.progress,
        log=run.log,
    )
    write_json(output.identified, identification.as_dict())
    run.log(identification.summary())


run_script(main, snakemake)
