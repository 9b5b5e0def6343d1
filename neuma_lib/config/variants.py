"""Names of folders: variants of a method, ``neuma+rank=4``, and replicates of a scene, ``BouncyBall+seed=1``.

A replicate is everything that is computed from a scene's images: prior, Gaussians, particles and adaptor. The folder of
a scene or experiment has its seeds in the name, except 0. Files that several replicates share have one folder,
`replicate_folder`, and are computed once.
"""

import re
from collections.abc import Collection, Iterable, Mapping

from neuma_lib.config.validation import hint
from neuma_lib.errors import InputError

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
"""Names of scenes, methods, captures, takes and cameras. Folders of results are named after them."""
RESERVED = ("benchmarks", "experiments", "figures", "kernels", "logs", "none", "priors", "weights")
"""Folders of results and data that belong to no scene or method, and what patterns contain in place of no name."""
SEEDS = ("prior", "gaussians", "particles", "adaptor")  # what the seeds of a replicate change, in order


def name_problem(name: str) -> str:
    """Why a name cannot be that of a scene, a method or a capture; empty if it can."""
    if not NAME.fullmatch(name) or len(name) > 80:
        return "a name must consist of at most 80 letters, digits, - and _, and not begin with - or _"
    return "this name is reserved for a folder of other files" if name in RESERVED else ""


def split_variant(
    text: str, bases: Iterable[str], keys: Collection[str], kind: str
) -> tuple[str, dict[str, str]]:
    """Split ``base+key=value+key=value``.

    Args:
        kind: for messages, for example "method".

    Raises:
        InputError: unknown base or key, a repeated key, or a piece without '='.
    """
    base, *pieces = text.split("+")
    if base not in bases:
        raise InputError(text, f"no {kind} '{base}'{hint(base, bases)}")
    variant: dict[str, str] = {}
    for piece in pieces:
        key, equals, value = piece.partition("=")
        if not equals or not key or not value:
            raise InputError(text, f"a variant of a {kind} is written +key=value, not '+{piece}'")
        if key not in keys:
            raise InputError(text, f"no option '{key}'{hint(key, keys)}")
        if key in variant:
            raise InputError(text, f"'{key}' is given twice")
        variant[key] = value
    return base, variant


def parse_replicate(text: str, bases: Iterable[str], kind: str) -> tuple[str, dict[str, int]]:
    """Base and seeds of a scene's or experiment's folder, for example ``BouncyBall+seed=1+prior_seed=0``.

    ``prior_seed``, ``gaussians_seed``, ``particles_seed`` and ``adaptor_seed`` override ``seed``.

    Returns:
        the base, and a seed for each of `SEEDS`.

    Raises:
        InputError: as `split_variant`, or a seed that is not an integer >= 0.
    """
    single = {f"{name}_seed": name for name in SEEDS}
    base, variant = split_variant(text, bases, ["seed", *single], kind)
    for key, value in variant.items():
        if not (value.isascii() and value.isdigit()):
            raise InputError(text, f"{key} must be an integer ≥ 0, not '{value}'")
    common = int(variant.get("seed", 0))
    return base, {name: int(variant.get(key, common)) for key, name in single.items()}


def replicate_folder(base: str, seeds: Mapping[str, int], names: Iterable[str] = SEEDS) -> str:
    """The folder of files that depend on some of the seeds of a replicate.

    Args:
        base: name of the scene or experiment.
        seeds: seeds by name, 0 if absent.
        names: the seeds that matter.
    """
    values = {name: seeds.get(name, 0) for name in names}
    if len(set(values.values())) == 1:
        values = {"": next(iter(values.values()))}
    return base + "".join(f"+{name}_seed={k}" if name else f"+seed={k}" for name, k in values.items() if k)
