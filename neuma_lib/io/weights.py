"""Tensors on disk: safetensors, with metadata, and files of torch.save, read without running what they hold."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from neuma_lib.errors import InputError
from neuma_lib.io.files import atomic, existing, one_line, parse_json


def write_weights(path: str | Path, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]) -> None:
    """Write tensors to safetensors, with metadata as one JSON text (their own header has no fixed order)."""
    kept = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with atomic(path) as partial:
        save_file(kept, partial, metadata={"neuma": json.dumps(metadata, sort_keys=True)})


def read_weights(path: str | Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Read tensors and metadata from safetensors.

    Raises:
        InputError: missing, truncated or foreign file, or weights that are not finite.
    """
    path = existing(path)
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            text = (file.metadata() or {}).get("neuma", "{}")
    except (SafetensorError, OSError) as error:
        raise InputError(
            f"{path} is not a readable safetensors file ({one_line(error)}): make it again"
        ) from None
    metadata = parse_json(text, f"{path}: its metadata")
    if not isinstance(metadata, dict):
        raise InputError(f"{path}: its metadata is no JSON object: make it again")
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise InputError(f"{path}: {one_line(name)} is not finite: train again")
    return tensors, metadata


def read_torch(path: str | Path) -> Any:
    """What torch.save wrote: tensors, numbers and texts in plain containers; nothing else is unpickled.

    Raises:
        InputError: missing, damaged or foreign file, or one that would need more memory than it has bytes.
    """
    path = existing(path)
    try:
        with zipfile.ZipFile(path) as archive:  # torch writes uncompressed ZIP archives since 1.6
            members = archive.infolist()
            if sum(member.file_size for member in members) > path.stat().st_size:
                raise InputError(f"{path} claims more data than it has bytes: do not use this file")
            # the one type that torch lets a file make at a size of its choice
            pickles = [archive.read(member) for member in members if member.filename.endswith(".pkl")]
            if any(b"bytearray" in content for content in pickles):
                raise InputError(f"{path} holds a bytearray, not only plain tensors: do not use this file")
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises many kinds for a damaged file
        if isinstance(error, InputError):
            raise
        reason = f"{type(error).__name__}: {one_line(error, 120)}"
        raise InputError(f"{path} is not a readable torch file of plain tensors ({reason})") from None
