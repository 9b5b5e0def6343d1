"""Names of folders that say which settings differ: ``neuma+rank=4`` of a method, ``BouncyBall+seed=1`` of a chain.

A chain is all that is computed from a scene's images: prior, Gaussians, particles and adaptor. Its seeds stand in the
name of the folder, of a scene or of an experiment; 0 is not written. What a chain shares with another one has one home,
`folder`, so that it is computed once.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from neuma_lib.config.validation import hint
from neuma_lib.errors import InputError

DRAWN = ("prior", "gaussians", "particles", "adaptor")
"""What a chain draws at random, in order."""


def split_variant(
    text: str, bases: Iterable[str], keys: Collection[str], kind: str
) -> tuple[str, dict[str, str]]:
    """Split ``base+key=value+key=value``.

    Args:
        text: the name.
        bases: known bases.
        keys: known keys.
        kind: what it names, for messages, for example "method".

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


def parse_chain(text: str, bases: Iterable[str], kind: str) -> tuple[str, dict[str, int]]:
    """Base and seeds of a scene's or experiment's folder, for example ``BouncyBall+seed=1+prior_seed=0``.

    ``seed`` is that of all that is drawn, ``prior_seed``, ``gaussians_seed``, ``particles_seed`` and ``adaptor_seed``
    are those of one thing.

    Returns:
        the base, and the seed of everything in `DRAWN`.

    Raises:
        InputError: as `split_variant`, or a seed that is no whole number from 0.
    """
    single = {f"{drawn}_seed": drawn for drawn in DRAWN}
    base, variant = split_variant(text, bases, ["seed", *single], kind)
    for key, value in variant.items():
        if not (value.isascii() and value.isdigit()):
            raise InputError(text, f"{key} must be an integer ≥ 0, not '{value}'")
    common = int(variant.get("seed", 0))
    return base, {drawn: int(variant.get(key, common)) for key, drawn in single.items()}


def folder(base: str, seeds: Mapping[str, int], drawn: Iterable[str] = DRAWN) -> str:
    """The one home of what depends on some of a chain's seeds.

    Args:
        base: name of the scene or experiment.
        seeds: the seed of everything in `DRAWN`; 0 where it is left out.
        drawn: what matters to it.
    """
    values = {name: seeds.get(name, 0) for name in drawn}
    if len(set(values.values())) == 1:
        values = {"": next(iter(values.values()))}
    return base + "".join(f"+{name}_seed={k}" if name else f"+seed={k}" for name, k in values.items() if k)
