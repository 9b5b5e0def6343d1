"""Files of laws: priors (our ``.safetensors``, the released NCLaw / NeuMA ``.pt``), adaptors (ours, the released
``*_lora.pt``) and exported laws (`save_law`).

The metadata of a ``.safetensors`` determine its kind: :data:`STRUCTURED` holds names and constants of the base of a
structured law, :data:`ANALYTIC` those of an analytic law without tensors. Any other file is a pair of NCLaw networks. A
file may contain an adaptor and the weights that it corrects, as that of a structured law does. It needs no prior then.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.io.exported import EXPORT, checked_export, fitting_step
from neuma_lib.io.files import existing, located, one_line
from neuma_lib.io.weights import read_torch, read_weights, write_weights
from neuma_lib.mechanics.adaptor import LAYER_KEYS, AdaptableLaw
from neuma_lib.mechanics.analytic import analytic_law, specification
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.mechanics.structured import StructuredLaw, structured_law

STRUCTURED, ANALYTIC = "structured", "analytic"
PICKLED = (".pt", ".pth")
RELEASED_ALPHA = 16.0
"""alpha of all released settings. Their files do not contain it; the rank follows from the shapes."""


def save_prior(path: str | Path, law: AdaptableLaw, metadata: Mapping[str, Any]) -> None:
    """Write the merged weights of a law and, for a structured law, its base: a file for `load_prior`."""
    own = {STRUCTURED: law.specification()} if isinstance(law, StructuredLaw) else {}
    write_weights(path, law.prior_state(), {**metadata, **own})


def save_law(path: str | Path, law: Law, about: Mapping[str, Any], separate_adaptor: bool = False) -> None:
    """Write a complete law to one file, for `load_law` and `load_prior`.

    Args:
        law: networks with or without an adaptor, a structured or an analytic law.
        about: result of `neuma_lib.io.exported.about_law`.
        separate_adaptor: do not merge the adaptor, with its weight w, with the weights that it corrects.

    Raises:
        InputError: ``separate_adaptor`` for a law without an adaptor.
    """
    own = {EXPORT: dict(about)}
    if not isinstance(law, AdaptableLaw):
        own[ANALYTIC] = specification(law.elasticity, law.plasticity, law.viscosity, law.field)
        write_weights(path, {}, own)
    elif separate_adaptor:
        adaptor = next(iter(law.parts.values())).adaptor
        if adaptor is None:
            raise InputError(f"law {law.name}", "has no adaptor to keep separate", "Omit separate_adaptor")
        save_adaptor(path, law, adaptor.rank, adaptor.alpha, own, complete=True)
    else:
        save_prior(path, law, own)


def load_prior(
    path: str | Path, device: torch.device | str = "cpu", dt: float | None = None, any_time_step: bool = False
) -> Law:
    """Law from a file; an adaptor in it is merged.

    Args:
        path: ``.safetensors`` of `save_prior` or `save_law`, or ``.pt``: a dict with ``elasticity`` and ``plasticity``,
            each with the three weights of an NCLaw network.
        dt: time step of the simulation [s]; None: that of the training.
        any_time_step: allow another time step than that of the training even if the law depends on it
            (`neuma_lib.mechanics.time_step`). Only files of `save_law` contain the step of the training.

    Raises:
        InputError: missing file, unknown format, missing weights or other shapes, unknown base, another time step.
    """
    law = _read_law(path, dt, any_time_step)
    for part in law.parts.values() if isinstance(law, AdaptableLaw) else ():
        if part.adaptor is not None:
            part.freeze(part.weights())
    return law.to(device)


def load_adaptable(path: str | Path, dt: float | None = None, any_time_step: bool = False) -> AdaptableLaw:
    """`load_prior` of a law to be trained. Raises InputError also for a law without networks."""
    law = load_prior(path, dt=dt, any_time_step=any_time_step)
    if not isinstance(law, AdaptableLaw):
        problem = "an analytic law has no networks to adapt"
        raise InputError(f"prior {path}", problem, "Use it with a method that trains nothing (nclaw)")
    return law


def _read_law(path: str | Path, dt: float | None, any_time_step: bool) -> Law:
    path = existing(path)
    metadata: Mapping[str, Any] = {}
    if path.suffix == ".safetensors":
        state, metadata = read_weights(path)
    elif path.suffix in PICKLED:
        state = _released(path, "prior")
    else:
        raise InputError(f"prior {path}", "expected .safetensors or .pt")
    try:
        if EXPORT in metadata:
            dt = fitting_step(checked_export(metadata), dt, any_time_step)
        if ANALYTIC in metadata:
            law = analytic_law(_specification(metadata[ANALYTIC], dt, ANALYTIC))
        elif STRUCTURED in metadata:
            law = structured_law(_specification(metadata[STRUCTURED], dt), state=state, name=path.stem)
        else:
            law = neural_law(state, name=path.stem)
        if "rank" in metadata:
            _attach(law, state, metadata)
        law.grid = _grid(metadata.get(EXPORT, metadata))
        return law
    except InputError as error:
        raise located(error, f"prior {path}") from None


def _specification(spec: Any, dt: float | None, key: str = STRUCTURED) -> dict[str, Any]:
    """Specification of an analytic law or of a base from the metadata, checked; its time step is replaced by ``dt``."""
    parts = [spec.get(part) for part in ("elasticity", "plasticity")] if isinstance(spec, dict) else [None]
    if isinstance(spec, dict):
        parts += [spec[part] for part in ("viscosity", "field") if part in spec]
    if not all(isinstance(part, dict) for part in parts):
        raise InputError(f"metadata {key}", "must have an elasticity and a plasticity")
    for name, value in ((name, value) for part in parts for name, value in part.items() if name != "name"):
        if type(value) not in (int, float) or not math.isfinite(value):
            raise InputError(f"constant {one_line(name)}", f"must be a number, not {one_line(value)}")
    if dt is None:
        return spec
    return {
        part: {**own, "dt": dt} if isinstance(own, dict) and "dt" in own else own
        for part, own in spec.items()
    }


def _released(path: Path, kind: str) -> dict[str, Tensor]:
    content = read_torch(path)
    parts = {}
    for part in ("elasticity", "plasticity"):
        if not isinstance(content, dict) or not isinstance(content.get(part), dict):
            raise InputError(f"{kind} {path}", "expected a dict with elasticity and plasticity")
        parts.update({f"{part}.{key}": value for key, value in content[part].items()})
    for key, value in parts.items():
        # an expanded tensor claims more than it stores
        if not isinstance(value, Tensor) or value.numel() * value.element_size() > path.stat().st_size:
            raise InputError(f"{kind} {path}: {one_line(key)}", "is not a tensor stored in the file")
        if not bool(value.isfinite().all()):
            raise InputError(f"{kind} {path}: {one_line(key)}", "is not finite")
    return parts


def _attach_released(law: AdaptableLaw, path: Path, alpha: float) -> None:
    """Attach a released adaptor, W = W0 + (alpha / rank) lora_B lora_A in every layer.

    lora_B is divided by the scale s of W0, which is a factor of our adaptor (`neuma_lib.mechanics.adaptor.Adaptor`).
    """
    tensors = _released(path, "adaptor")
    ranks = {len(value) for key, value in tensors.items() if key.endswith("lora_A") and value.ndim}
    if len(ranks) != 1:
        raise InputError(f"adaptor {path}", "must have lora_A and lora_B of one rank in every layer")
    (rank,) = ranks
    law.attach_adaptor(rank, alpha)
    for name, part in law.parts.items():
        for layer, key in enumerate(LAYER_KEYS):
            for matrix, own in (("A", part.adaptor.A[layer]), ("B", part.adaptor.B[layer])):
                theirs = f"{name}.{key.replace('weight', f'lora_{matrix}')}"
                value = tensors.get(theirs)
                if value is None or value.shape != own.shape:
                    shape = "is missing" if value is None else f"has the shape {tuple(value.shape)}"
                    problem = f"{shape}, but the prior needs {tuple(own.shape)}"
                    raise InputError(f"adaptor {path}: {theirs}", problem)
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
    """Write the tensors of a law's adaptor, with rank and alpha.

    Args:
        complete: also write the corrected weights; weights and base of a structured law are always written.
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
    any_time_step: bool = False,
    released_alpha: float = RELEASED_ALPHA,
) -> Law:
    """A law from one file, with its adaptor attached if it has one, or from a prior and a trained adaptor.

    Args:
        prior: file of the prior, or of `save_law`; None for the adaptor of a structured law, whose file has its base.
        adaptor: file of the adaptor, ours or a released ``*_lora.pt``.
        dt, any_time_step: see `load_prior`.
        released_alpha: numerator of the scale of a released adaptor.
    """
    if adaptor is None:
        if prior is None:
            raise InputError("prior", "is missing", "Give a prior, or the adaptor of a structured law")
        return _read_law(prior, dt, any_time_step)
    without_prior = InputError(adaptor, "the adaptor corrects a prior", "Give the file of the prior too")
    if Path(adaptor).suffix in PICKLED:
        if prior is None:
            raise without_prior
        law = load_adaptable(prior, dt, any_time_step)
        _attach_released(law, existing(adaptor), released_alpha)
        return law
    tensors, metadata = read_weights(adaptor)
    if "rank" not in metadata or "alpha" not in metadata:
        raise InputError(adaptor, "is not an adaptor of this project: its metadata have no rank and alpha")
    if prior is None and STRUCTURED not in metadata:
        raise without_prior
    law = None if prior is None else load_adaptable(prior, dt, any_time_step)
    try:
        if law is None:
            spec = _specification(metadata[STRUCTURED], dt)
            law = structured_law(spec, state=tensors, name=Path(adaptor).parent.name)
        _attach(law, tensors, metadata)
        law.grid = _grid(metadata)
    except InputError as error:
        raise located(error, adaptor) from None
    return law


def _grid(metadata: Mapping[str, Any]) -> int | None:
    """Grid that a law was learned on, if the metadata state it."""
    grid = metadata.get("grid")
    if grid is not None and not (type(grid) is int and grid > 0):
        raise InputError("grid", f"{one_line(grid)} in the metadata must be a positive number of cells")
    return grid


def _attach(law: AdaptableLaw, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any]) -> None:
    """Attach the adaptor in the tensors of a file."""
    rank, alpha = metadata["rank"], metadata.get("alpha")
    largest = max((length for tensor in tensors.values() for length in tensor.shape), default=0)
    if rank is not None and not (type(rank) is int and 0 < rank <= largest):
        raise InputError("rank", f"{one_line(rank)} in the metadata does not match the tensors")
    if type(alpha) not in (int, float) or not math.isfinite(alpha):
        raise InputError("alpha", f"must be a number, not {one_line(alpha)}")
    own = {key: tensor for key, tensor in tensors.items() if key.partition(".")[2] not in LAYER_KEYS}
    law.load_adaptor_state(own, rank=rank, alpha=alpha)
