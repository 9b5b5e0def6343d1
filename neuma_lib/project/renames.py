"""Keys of the settings that have another name now."""

from collections.abc import Iterator, Mapping
from typing import Any

from neuma_lib.config.validation import joined
from neuma_lib.errors import InputError

RENAMED = {
    "material": "training",
    "scenes.*.material": "scenes.*.training",
    "simulation.particles": "geometry.particles",
    "simulation.walls": "simulation.contact",
    "dataset.sub_frames": "dataset.exposure_samples",
    "identify.particles": "identify.refined_particles",
    "identify.misplaced": "identify.pose_tolerance",
    "identify.squares": "identify.pyramid",
    "identify.least_gain": "identify.min_gain",
    "identify.give_up": "identify.prune_factor",
    "methods.*.judged_on": "methods.*.evaluate_on",
    "methods.*.law": "methods.*.kind",
    "methods.*.material": "methods.*.options",
    "methods.*.options.carrier": "methods.*.options.particle_source",
    "methods.*.pac_nerf": "methods.*.options",
    "methods.*.prior": "methods.*.options.prior",
    "methods.*.springs": "methods.*.options",
    "methods.*.structured": "methods.*.options",
    "methods.*.trained_as": "methods.*.same_fit_as",
    "pac_nerf.least_opacity": "pac_nerf.min_opacity",
    "pac_nerf.most_frames": "pac_nerf.max_frames",
    "radiance.least_opacity": "radiance.min_opacity",
    "radiance.entropy_most": "radiance.max_entropy_weight",
    "tables.*.on_request": "tables.*.default_target",
}
"""Old path -> new path. A star is the name of a scene, method or table."""
OPPOSITE = {"tables.*.on_request"}  # old keys whose values are the opposite of the new ones


def refuse_old_keys(raw: Mapping[str, Any]) -> None:
    """Raise an InputError that gives the new name of every renamed key in raw settings, also below ``advanced``."""
    errors = []
    for old, new in RENAMED.items():
        for path, names in _matches(raw, old.split("."), ()):
            parts = iter(names)
            now = ".".join(next(parts) if step == "*" else step for step in new.split("."))
            opposite = ", which has the opposite meaning" if old in OPPOSITE else ""
            errors.append(InputError(path, f"was renamed to {now}{opposite}"))
        if old in (raw.get("advanced") or {}):
            errors.append(InputError(f"advanced.{old}", f"was renamed to {new}"))
    if errors:
        raise joined(errors)


def _matches(raw: Any, steps: list[str], names: tuple[str, ...]) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Paths of a pattern in nested dicts, and what its stars are."""
    if not isinstance(raw, Mapping):
        return
    first, *others = steps
    for key in list(raw) if first == "*" else [first] * (first in raw):
        here = (*names, key) if first == "*" else names
        if not others:
            yield key, here
        else:
            for path, stars in _matches(raw[key], others, here):
                yield f"{key}.{path}", stars
