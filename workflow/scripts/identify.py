"""Find the family and the constants of the material in one video or several."""

import torch

from neuma_lib.config.binding import BindingConfig
from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.device import choose_device
from neuma_lib.fitting.identify import identify
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.files import listed, read_json, write_json
from neuma_lib.io.images import load_videos
from neuma_lib.io.mesh import read_mesh
from neuma_lib.io.particles import load_reconstruction
from neuma_lib.io.simulator import simulator
from neuma_lib.threads import use_threads
from workflow.stage import run_script


def main(inputs, output, params, run) -> None:
    use_threads(snakemake.threads)
    settings, binding = IdentifyConfig(**params.identify), BindingConfig(**params.binding)
    device = choose_device(params.device)
    names = ("particles", "binding", "gaussians", "velocity", "transforms")
    videos = [
        (
            InitialMotion.of(read_json(velocity)),
            load_reconstruction(*body, density, gaussian_motion=settings.gaussian_motion).to(
                torch.float32, device
            ),
            [
                video.to(torch.float32, device)
                for video in load_videos(transforms, settings.views, **params.exposure)
            ],
        )
        for *body, velocity, transforms, density in zip(
            *(listed(inputs[name]) for name in names), params.densities, strict=True
        )
    ]
    refined = []
    for (_, body, _), file, density in zip(videos, listed(inputs.mesh), params.densities, strict=True):
        if settings.refined_particles:
            mesh = read_mesh(file)
            x = torch.from_numpy(sample_volume(mesh, settings.refined_particles, params.seed + 1))
            refined.append(body.resampled(x, mesh.volume, density, binding))
    identification = identify(
        simulator(params.simulation),
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
