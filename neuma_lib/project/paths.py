"""Where the files of a project lie: those of scenes and experiments in their chains, and those that a law is made of.

Names only; nothing is read, and nothing need exist.
"""

from __future__ import annotations

import re

from neuma_lib.config.variants import folder
from neuma_lib.project.settings import Config

FIELD = "pac_nerf/field.safetensors"
IDENTIFIED = "identified"
"""Name of the prior that is the law identified in the scene's own video."""
DRAWN_IN = {
    **dict.fromkeys(["gaussians.ply", "gaussians.json", "mesh.ply", "tracers.h5", FIELD], ["gaussians"]),
    **dict.fromkeys(["sampled_particles.h5", "particles.h5", "binding.h5"], ["gaussians", "particles"]),
    **dict.fromkeys(
        ["velocity.json", "identified.json", "priors/identified.safetensors", "visited.h5"],
        ["prior", "gaussians", "particles"],
    ),
}
"""Seeds that change a file of a scene or an experiment. For runs of methods see
`neuma_lib.project.cases.run_folder`."""


def home(settings: Config, name: str, file: str) -> str:
    """The one path of a file of a scene or experiment in a chain."""
    results, (base, seeds) = results_root(settings), settings.chain(name)
    if base in settings.scenes:
        drawn = DRAWN_IN[re.sub("[+]views=[0-9,]+", "", file)]
        return f"{results}/{folder(base, seeds, drawn)}/{file}"
    # Solids are filled with particles; where a scene's own object is among them, all that led to its start counts.
    rebuilt = any(body.shape is None for body in settings.experiments[base].bodies)
    drawn = DRAWN_IN["velocity.json"] if rebuilt else ["particles"]
    return f"{results}/experiments/{folder(base, seeds, drawn)}/{file}"


def results_root(settings: Config) -> str:
    return settings.results_root.rstrip("/")


def prior_file(settings: Config, scene: str, prior: str) -> str:
    """The file of a prior in the replicate of a scene: made here, or the user's own if the name is a path."""
    if prior == IDENTIFIED:
        return home(settings, scene, "priors/identified.safetensors")
    if prior not in settings.priors.laws:
        return prior
    return f"{results_root(settings)}/priors/{folder(prior, settings.chain(scene)[1], ['prior'])}.safetensors"
