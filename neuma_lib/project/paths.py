"""Paths of the files of a project: of scenes and experiments in their replicates, and of priors.

No file is read or has to exist.
"""

import re

from neuma_lib.config.variants import replicate_folder
from neuma_lib.project.settings import Config

FIELD = "pac_nerf/field.safetensors"
IDENTIFIED = "identified"  # name of the prior that is the law identified from the scene's video
SEEDS_OF = {
    **dict.fromkeys(
        ["gaussians.ply", "gaussians.json", "whole.ply", "mesh.ply", "tracers.h5", FIELD], ["gaussians"]
    ),
    **dict.fromkeys(["sampled_particles.h5", "particles.h5", "binding.h5"], ["gaussians", "particles"]),
    **dict.fromkeys(
        ["velocity.json", "motions.json", "identified.json", "priors/identified.safetensors", "visited.h5"],
        ["prior", "gaussians", "particles"],
    ),
}
"""Seeds that change a file of a scene or an experiment. For runs of methods see
`neuma_lib.project.cases.run_folder`."""


def result_path(settings: Config, name: str, file: str) -> str:
    """Path of a file of a scene or experiment in a replicate."""
    results, (base, seeds) = results_root(settings), settings.replicate(name)
    if base in settings.scenes:
        seeds_used = SEEDS_OF[re.sub("[+]views=[0-9,]+", "", file)]
        return f"{results}/{replicate_folder(base, seeds, seeds_used)}/{file}"
    # Shapes are filled with particles. A reconstructed object depends on everything before its initial motion.
    rebuilt = any(body.shape is None for body in settings.experiments[base].bodies)
    seeds_used = SEEDS_OF["velocity.json"] if rebuilt else ["particles"]
    return f"{results}/experiments/{replicate_folder(base, seeds, seeds_used)}/{file}"


def results_root(settings: Config) -> str:
    return settings.results_root.rstrip("/")


def prior_file(settings: Config, scene: str, prior: str) -> str:
    """The file of a prior in the replicate of a scene: in the results, or the name itself if it is a path."""
    if prior == IDENTIFIED:
        return result_path(settings, scene, "priors/identified.safetensors")
    if prior not in settings.priors.laws:
        return prior
    name = replicate_folder(prior, settings.replicate(scene)[1], ["prior"])
    return f"{results_root(settings)}/priors/{name}.safetensors"
