"""Files of laws: priors (our own ``.safetensors``, the released NCLaw / NeuMA ``.pt``), adaptors (ours, the released
``*_lora.pt``), and laws to pass on (`save_law`).

A ``.safetensors`` whose metadata have :data:`STRUCTURED` holds a structured law, with its base's names and constants
there, one with :data:`ANALYTIC` has nothing else; any other is a pair of NCLaw networks. Whoever loads a law need not
know which. A file may have an adaptor beside the weights that it corrects, as that of a structured law always does, and
needs no prior then.
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
from neuma_lib.io.exported import EXPORT, checked_export, fitting_step
from neuma_lib.io.files import existing, one_line, read_json
from neuma_lib.io.weights import read_torch, read_weights, write_weights
from neuma_lib.mechanics.adaptor import LAYER_KEYS, AdaptableLaw
from neuma_lib.mechanics.analytic import analytic_law, specification
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.mechanics.structured import StructuredLaw, structured_law

STRUCTURED, ANALYTIC = "structured", "analytic"
PICKLED = (".pt", ".pth")
RELEASED_ALPHA = 16.0
"""alpha of all released settings; their files have the rank, in the shapes, but not this."""


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


def save_law(path: str | Path, law: Law, about: Mapping[str, Any], apart: bool = False) -> None:
    """Write a law that is complete in one file, for `load_law` and `load_prior`.

    Args:
        law: networks with an adaptor or without, a structured or an analytic law.
        about: what `neuma_lib.io.exported.about_law` says of it.
        apart: keep the adaptor beside the weights that it corrects, instead of merging it with the weight w that it
            has.

    Raises:
        InputError: ``apart`` of a law that has no adaptor.
    """
    own = {EXPORT: dict(about)}
    if not isinstance(law, AdaptableLaw):
        own[ANALYTIC] = specification(law.elasticity, law.plasticity)
        write_weights(path, {}, own)
    elif apart:
        adaptor = next(iter(law.parts.values())).adaptor
        if adaptor is None:
            raise InputError(f"law {law.name}: it has no adaptor that could be kept apart; leave out apart")
        save_adaptor(path, law, adaptor.rank, adaptor.alpha, own, complete=True)
    else:
        save_prior(path, law, own)


def load_prior(
    path: str | Path, device: torch.device | str = "cpu", dt: float | None = None, any_step: bool = False
) -> Law:
    """Law from a file; an adaptor in it is merged.

    Args:
        path: ``.safetensors`` of `save_prior` or `save_law`, or ``.pt``: a dict with ``elasticity`` and ``plasticity``,
            each with the three weights of an NCLaw network.
        dt: time step [s] of its use; None: the one that it was made for.
        any_step: use it at another step than that of its learning even if it does not follow
            (`neuma_lib.mechanics.time_step`); only files of `save_law` know that one.

    Raises:
        InputError: no such file, another format, missing weights or other shapes, a base that there is none of, another
            time step.
    """
    law = _read_law(path, dt, any_step)
    for part in law.parts.values() if isinstance(law, AdaptableLaw) else ():
        if part.adaptor is not None:
            part.freeze(part.weights())
    return law.to(device)


def load_adaptable(path: str | Path, dt: float | None = None, any_step: bool = False) -> AdaptableLaw:
    """The same of a law to be trained. Raises InputError, too, where it has no networks."""
    law = load_prior(path, dt=dt, any_step=any_step)
    if not isinstance(law, AdaptableLaw):
        raise InputError(
            f"prior {path}: it is an analytic law, without networks that could be adapted; a method that trains "
            "nothing (nclaw) takes it as it is"
        )
    return law


def _read_law(path: str | Path, dt: float | None, any_step: bool) -> Law:
    path = existing(path)
    metadata: Mapping[str, Any] = {}
    if path.suffix == ".safetensors":
        state, metadata = read_weights(path)
    elif path.suffix in PICKLED:
        state = _released(path, "prior")
    else:
        raise InputError(f"prior {path}: expected .safetensors or .pt")
    try:
        if EXPORT in metadata:
            dt = fitting_step(checked_export(metadata), dt, any_step)
        if ANALYTIC in metadata:
            return analytic_law(_specification(metadata[ANALYTIC], dt, ANALYTIC))
        if STRUCTURED in metadata:
            law = structured_law(_specification(metadata[STRUCTURED], dt), state=state, name=path.stem)
        else:
            law = neural_law(state, name=path.stem)
        if "rank" in metadata:
            _attach(law, state, metadata)
        return law
    except InputError as error:
        raise InputError(f"prior {path}: {one_line(error, 600)}") from None


def _specification(found: Any, dt: float | None, key: str = STRUCTURED) -> dict[str, Any]:
    """An analytic law, or the base of a structured one, as a file has it but for the time step, where one is given."""
    parts = [found.get(part) for part in ("elasticity", "plasticity")] if isinstance(found, dict) else [None]
    if not all(isinstance(part, dict) for part in parts):
        raise InputError(f"its metadata {key} must have an elasticity and a plasticity")
    for name, value in ((name, value) for part in parts for name, value in part.items() if name != "name"):
        if type(value) not in (int, float) or not math.isfinite(value):
            raise InputError(f"its constant {one_line(name)} must be a number, not {one_line(value)}")
    if dt is not None and "dt" in found["plasticity"]:
        return {**found, "plasticity": {**found["plasticity"], "dt": dt}}
    return found


def _released(path: Path, kind: str) -> dict[str, Tensor]:
    content = read_torch(path)
    parts = {}
    for part in ("elasticity", "plasticity"):
        if not isinstance(content, dict) or not isinstance(content.get(part), dict):
            raise InputError(f"{kind} {path}: expected a dict with elasticity and plasticity")
        parts.update({f"{part}.{key}": value for key, value in content[part].items()})
    for key, value in parts.items():
        # an expanded tensor is larger than its memory
        if not isinstance(value, Tensor) or value.numel() * value.element_size() > path.stat().st_size:
            raise InputError(f"{kind} {path}: {one_line(key)} is not a tensor that the file holds")
        if not bool(value.isfinite().all()):
            raise InputError(f"{kind} {path}: {one_line(key)} is not finite")
    return parts


def _attach_released(law: AdaptableLaw, path: Path, alpha: float) -> None:
    """Attach a released adaptor, W = W0 + (alpha / rank) lora_B lora_A in every layer.

    Ours has the size s of W0 as a factor (`neuma_lib.mechanics.adaptor.Adaptor`), by which lora_B is divided.
    """
    found = _released(path, "adaptor")
    ranks = {len(value) for key, value in found.items() if key.endswith("lora_A") and value.ndim}
    if len(ranks) != 1:
        raise InputError(f"adaptor {path}: expected lora_A and lora_B of every layer, of one rank")
    (rank,) = ranks
    law.attach_adaptor(rank, alpha)
    for name, part in law.parts.items():
        for layer, key in enumerate(LAYER_KEYS):
            for matrix, own in (("A", part.adaptor.A[layer]), ("B", part.adaptor.B[layer])):
                theirs = f"{name}.{key.replace('weight', f'lora_{matrix}')}"
                value = found.get(theirs)
                if value is None or value.shape != own.shape:
                    shape = "missing" if value is None else f"of shape {tuple(value.shape)}"
                    raise InputError(
                        f"adaptor {path}: {theirs} is {shape}, where the prior needs {tuple(own.shape)}"
                    )
                scale = part.adaptor.scales[layer] if matrix == "B" else 1.0
                own.data.copy_(value.to(own) / scale)


def save_adaptor(
    path: str | Path,
    law: AdaptableLaw,
    rank: int | None,
    alpha: float,
    metadata: Mapping[str, Any],
    complete: bool = False,
) -> None:
    """Write the tensors of a law's adaptor, with what is needed to attach them again.

    Args:
        complete: write the weights that it corrects too; those of a structured law, and its base, always are.
    """
    own, base = {}, {}
    if isinstance(law, StructuredLaw):
        own = {STRUCTURED: law.specification()}
    if own or complete:
        base = {
            f"{name}.{key}": weight.detach().clone()
            for name, part in law.parts.items()
            for key, weight in zip(LAYER_KEYS, part.base, strict=True)
        }
    write_weights(path, {**base, **law.adaptor_state()}, {"rank": rank, "alpha": alpha, **own, **metadata})


def load_law(
    prior: str | Path | None,
    adaptor: str | Path | None = None,
    dt: float | None = None,
    any_step: bool = False,
    released_alpha: float = RELEASED_ALPHA,
) -> Law:
    """A law: that of one file, with its adaptor attached if it has one, or a prior with a trained adaptor.

    Args:
        prior: file of the prior, or of a law of `save_law`; None if the adaptor is that of a structured law, whose file
            has its base.
        adaptor: file of the adaptor, ours or a released ``*_lora.pt``.
        dt, any_step: as of `load_prior`.
        released_alpha: numerator of the scale of a released adaptor.
    """
    if adaptor is None:
        if prior is None:
            raise InputError("a law needs the file of a prior or that of a structured law's adaptor")
        return _read_law(prior, dt, any_step)
    if Path(adaptor).suffix in PICKLED:
        if prior is None:
            raise InputError(f"{adaptor} corrects a prior: give its file too")
        law = load_adaptable(prior, dt, any_step)
        _attach_released(law, existing(adaptor), released_alpha)
        return law
    tensors, metadata = read_weights(adaptor)
    if "rank" not in metadata or "alpha" not in metadata:
        raise InputError(f"{adaptor} has no rank and alpha in its metadata: it is no adaptor of this project")
    if prior is None and STRUCTURED not in metadata:
        raise InputError(f"{adaptor} corrects a prior: give its file too")
    law = None if prior is None else load_adaptable(prior, dt, any_step)
    try:
        if law is None:
            spec = _specification(metadata[STRUCTURED], dt)
            law = structured_law(spec, state=tensors, name=Path(adaptor).parent.name)
        _attach(law, tensors, metadata)
    except InputError as error:
        raise InputError(f"{adaptor}: {one_line(error)}") from None
    return law


def _attach(law: AdaptableLaw, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> None:
    """Attach the adaptor that is among the tensors of a file."""
    rank, alpha = metadata["rank"], metadata.get("alpha")
    largest = max((length for tensor in tensors.values() for length in tensor.shape), default=0)
    if rank is not None and not (type(rank) is int and 0 < rank <= largest):
        raise InputError(f"the rank {one_line(rank)} in its metadata is not that of its tensors")
    if type(alpha) not in (int, float) or not math.isfinite(alpha):
        raise InputError(f"alpha must be a number, not {one_line(alpha)}")
    own = {key: tensor for key, tensor in tensors.items() if key.partition(".")[2] not in LAYER_KEYS}
    law.load_adaptor_state(own, rank=rank, alpha=alpha)
