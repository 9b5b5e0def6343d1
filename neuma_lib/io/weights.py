"""Weights of networks as safetensors."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuma_lib.errors import InputError
from neuma_lib.io.files import atomic, existing


def write_weights(path: str | Path, tensors: Mapping[str, Any], metadata: Mapping[str, Any]) -> None:
    """Write torch tensors to safetensors, with metadata as one JSON text (their own header has no fixed order)."""
    from safetensors.torch import save_file

    kept = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with atomic(path) as partial:
        save_file(kept, partial, metadata={"neuma": json.dumps(metadata, sort_keys=True)})


def read_weights(path: str | Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read torch tensors and metadata from safetensors.

    Raises:
        InputError: missing, truncated or foreign file, or weights that are not finite.
    """
    from safetensors import SafetensorError, safe_open

    path = existing(path)
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            metadata = json.loads((file.metadata() or {}).get("neuma", "{}"))
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is not a readable safetensors file ({error}): make it again") from None
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise InputError(f"{path}: {name} is not finite: train again")
    return tensors, metadata
