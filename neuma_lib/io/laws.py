"""Files of trainable laws: priors (our own ``.safetensors``, the released NCLaw / NeuMA ``.pt``) and adaptors.

A ``.safetensors`` whose metadata have :data:`STRUCTURED` holds a structured law, with its base's names and constants
there; any other is a pair of NCLaw networks. Whoever loads a law need not know which. The adaptor of a structured law
has its base in the same file and needs no prior beside it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.io.files import existing, one_line, read_json
from neuma_lib.io.weights import read_torch, read_weights, write_weights
from neuma_lib.mechanics.adaptor import LAYER_KEYS, AdaptableLaw
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.mechanics.structured import StructuredLaw, structured_law

STRUCTURED = "structured"


def load_laws(
    dt: float,
    specs: Sequence[Mapping[str, Any]] = (),
    identified: Sequence[str | Path] = (),
    priors: Sequence[str | Path] = (),
    adaptors: Sequence[str | Path] = (),
) -> list[Law]:
    """The laws of a method's bodies: analytic ones from specifications or identified.json, or trained ones.

    Args:
        dt: time step [s].
        specs: what `analytic_law` takes, a body each; empty where the method has no such law.
        identified: files of the stage `identify`, likewise.
        priors, adaptors: files of trained laws, likewise; without adaptors the priors as they are, and without priors
            those of structured laws.
    """
    specs = specs or [read_json(file)["law"] for file in identified]
    if specs:
        return [analytic_law(spec, dt=dt) for spec in specs]
    return [load_law(prior, adaptor, dt) for prior, adaptor in zip_longest(priors, adaptors)]


def save_prior(path: str | Path, law: AdaptableLaw, metadata: Mapping[str, Any]) -> None:
    """Write a law's merged weights and, for a structured law, what it corrects: a file for `load_prior`."""
    own = {STRUCTURED: law.specification()} if isinstance(law, StructuredLaw) else {}
    write_weights(path, law.prior_state(), {**metadata, **own})


def load_prior(path: str | Path, device: torch.device | str = "cpu", dt: float | None = None) -> AdaptableLaw:
    """Law from a file.

    Args:
        path: ``.safetensors`` of `save_prior`, or ``.pt``: a dict with ``elasticity`` and ``plasticity``, each with the
            three weights of an NCLaw network.
        dt: time step [s] for a structured law that depends on the rate; None: the one that it was made for.

    Raises:
        InputError: no such file, another format, missing weights or other shapes, a base that there is none of.
    """
    path = existing(path)
    metadata: Mapping[str, Any] = {}
    if path.suffix == ".safetensors":
        state, metadata = read_weights(path)
    elif path.suffix in (".pt", ".pth"):
        state = _released(path)
    else:
        raise InputError(f"prior {path}: expected .safetensors or .pt")
    try:
        if STRUCTURED in metadata:
            law = structured_law(_specification(metadata[STRUCTURED], dt), state=state, name=path.stem)
        else:
            law = neural_law(state, name=path.stem)
        return law.to(device)
    except InputError as error:
        raise InputError(f"prior {path}: {one_line(error)}") from None


def _specification(found: Any, dt: float | None) -> dict[str, Any]:
    """The base of a structured law, as its file has it but for the time step, where one is given."""
    parts = [found.get(part) for part in ("elasticity", "plasticity")] if isinstance(found, dict) else [None]
    if not all(isinstance(part, dict) for part in parts):
        raise InputError(f"its metadata {STRUCTURED} must have an elasticity and a plasticity")
    for key, value in ((key, value) for part in parts for key, value in part.items() if key != "name"):
        if type(value) not in (int, float) or not math.isfinite(value):
            raise InputError(f"its constant {one_line(key)} must be a number, not {one_line(value)}")
    if dt is not None and "dt" in found["plasticity"]:
        return {**found, "plasticity": {**found["plasticity"], "dt": dt}}
    return found


def _released(path: Path) -> dict[str, Tensor]:
    content = read_torch(path)
    parts = {}
    for part in ("elasticity", "plasticity"):
        if not isinstance(content, dict) or not isinstance(content.get(part), dict):
            raise InputError(f"prior {path}: expected a dict with elasticity and plasticity")
        parts.update({f"{part}.{key}": value for key, value in content[part].items()})
    for key, value in parts.items():
        # an expanded tensor is larger than its memory
        if not isinstance(value, Tensor) or value.numel() * value.element_size() > path.stat().st_size:
            raise InputError(f"prior {path}: {one_line(key)} is not a tensor that the file holds")
        if not bool(value.isfinite().all()):
            raise InputError(f"prior {path}: {one_line(key)} is not finite")
    return parts


def save_adaptor(
    path: str | Path, law: AdaptableLaw, rank: int | None, alpha: float, metadata: Mapping[str, Any]
) -> None:
    """Write the tensors of a law's adaptor, with what is needed to attach them again; a structured law's base too."""
    own, base = {}, {}
    if isinstance(law, StructuredLaw):
        own = {STRUCTURED: law.specification()}
        base = {
            f"{name}.{key}": weight.detach().clone()
            for name, part in law.parts.items()
            for key, weight in zip(LAYER_KEYS, part.base, strict=True)
        }
    write_weights(path, {**base, **law.adaptor_state()}, {"rank": rank, "alpha": alpha, **own, **metadata})


def load_law(
    prior: str | Path | None, adaptor: str | Path | None = None, dt: float | None = None
) -> AdaptableLaw:
    """A prior, with a trained adaptor attached if one is given.

    Args:
        prior: file of the prior; None if the adaptor is that of a structured law, whose file has its base.
        adaptor: file of the adaptor.
        dt: time step [s] for a structured law that depends on the rate; None: the one that it was made for.
    """
    if adaptor is None:
        if prior is None:
            raise InputError("a law needs the file of a prior or that of a structured law's adaptor")
        return load_prior(prior, dt=dt)
    tensors, metadata = read_weights(adaptor)
    if "rank" not in metadata or "alpha" not in metadata:
        raise InputError(f"{adaptor} has no rank and alpha in its metadata: it is no adaptor of this project")
    rank, alpha = metadata["rank"], metadata["alpha"]
    largest = max((length for tensor in tensors.values() for length in tensor.shape), default=0)
    if rank is not None and not (type(rank) is int and 0 < rank <= largest):
        raise InputError(f"{adaptor}: the rank {one_line(rank)} in its metadata is not that of its tensors")
    if type(alpha) not in (int, float) or not math.isfinite(alpha):
        raise InputError(f"{adaptor}: alpha must be a number, not {one_line(alpha)}")
    base = {key: tensor for key, tensor in tensors.items() if key.partition(".")[2] in LAYER_KEYS}
    if prior is None and STRUCTURED not in metadata:
        raise InputError(f"{adaptor} corrects a prior: give its file too")
    law = None if prior is None else load_prior(prior, dt=dt)
    try:
        if law is None:
            spec = _specification(metadata[STRUCTURED], dt)
            law = structured_law(spec, state=base, name=Path(adaptor).parent.name)
        own = {key: tensor for key, tensor in tensors.items() if key not in base}
        law.load_adaptor_state(own, rank=rank, alpha=alpha)
    except InputError as error:
        raise InputError(f"{adaptor}: {one_line(error)}") from None
    return law
