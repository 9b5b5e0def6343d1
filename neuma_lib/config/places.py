"""Where the files of a project lie: those of scenes and experiments in their chains, and those that a law is made of.

Names only; nothing is read, and nothing need exist.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from neuma_lib.config.methods import IDENTIFIED
from neuma_lib.config.settings import Config
from neuma_lib.config.variants import folder
from neuma_lib.errors import InputError

FIELD = "pac_nerf/field.safetensors"
DRAWN_IN = {
    **dict.fromkeys(["gaussians.ply", "gaussians.json", "mesh.ply", "tracers.h5", FIELD], ["gaussians"]),
    **dict.fromkeys(["sampled_particles.h5", "particles.h5", "binding.h5"], ["gaussians", "particles"]),
    **dict.fromkeys(
        ["velocity.json", "identified.json", "priors/identified.safetensors", "visited.h5"],
        ["prior", "gaussians", "particles"],
    ),
}
"""What a chain's seeds change in a file of a scene or an experiment; runs of methods have `Config.run_folder`."""


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


def prior_file(settings: Config, scene: str, method: str | None = None) -> str:
    """The prior of a scene, or of a method there, in its chain: made here, or the user's own if it is a path."""
    name = settings.method_prior(scene, method) if method else settings.scene(scene).prior
    if name == IDENTIFIED:
        return home(settings, scene, "priors/identified.safetensors")
    if name not in settings.priors.laws:
        return name
    return f"{results_root(settings)}/priors/{folder(name, settings.chain(scene)[1], ['prior'])}.safetensors"


def identified_name(settings: Config, scene: str, method: str) -> str:
    """The file of what was identified for a method: in the views of its training, if these are its own."""
    views = settings.identified_views(scene, method)
    return f"identified+views={','.join(map(str, views))}.json" if views else "identified.json"


def pac_nerf_file(settings: Config, scene: str, method: str) -> str:
    """The law, and the throw, that PAC-NeRF found in a scene's video."""
    run = settings.run_folder(scene, settings.method_training(method))
    return f"{results_root(settings)}/{run}/constants.json"


@dataclass(frozen=True)
class LawFiles:
    """What a method's law is made of, as `neuma_lib.io.laws.load_laws` takes it.

    Attributes:
        spec: an analytic law, or None.
        identified, prior, adaptor: files, or None.
    """

    spec: dict[str, Any] | None = None
    identified: str | None = None
    prior: str | None = None
    adaptor: str | None = None


def law_files(settings: Config, scene: str, method: str) -> LawFiles:
    """The law that a method evaluates on a scene.

    Args:
        scene: with the seeds of its chain.

    Raises:
        InputError: the method has springs and no law, or what `Config` refuses.
    """
    if settings.is_springs(method):
        raise InputError(f"{method} has no law of a material, only springs in one body")
    if spec := settings.true_law(scene, method):
        return LawFiles(spec=spec)
    source = settings.law_scene(scene, method)
    if settings.is_pac_nerf(method):
        return LawFiles(identified=pac_nerf_file(settings, source, method))
    if settings.is_identified(method):
        return LawFiles(identified=home(settings, source, identified_name(settings, source, method)))
    adaptor = None
    if settings.method_material(scene, method).train:
        run = settings.run_folder(source, settings.method_training(method))
        adaptor = f"{results_root(settings)}/{run}/adaptor.safetensors"
    prior = None if settings.is_structured(method) else prior_file(settings, source, method)
    return LawFiles(prior=prior, adaptor=adaptor)


def law_origin(settings: Config, scene: str, method: str) -> dict[str, Any]:
    """What the settings say of where a method's law comes from, keys as of `neuma_lib.io.exported`."""
    source = settings.law_scene(scene, method)
    chosen = settings.scene(source)
    networks = law_files(settings, scene, method).prior is not None
    return {
        "dt": chosen.dt,
        **settings.scene_world(source),
        "density": settings.method_density(source, method),
        "scale": chosen.captured.scale if chosen.captured else chosen.images.scale,
        "scene": source,
        "method": method,
        "prior": settings.method_prior(scene, method) if networks else None,
    }
