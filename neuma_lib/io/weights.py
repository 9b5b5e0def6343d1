"""Tensors on disk: safetensors with metadata, and files of torch.save, which are read without executing code."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save

from neuma_lib.io.files import atomic, existing, parse_json, reading, zip_member


def write_weights(path: str | Path, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]) -> None:
    """Write tensors to safetensors, with metadata as one JSON text (the order of the header is not fixed)."""
    kept = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    content = save(kept, metadata={"neuma": json.dumps(metadata, sort_keys=True)})
    with atomic(path) as partial:
        partial.write_bytes(content)  # save_file sets permissions that exclude other users


def read_weights(path: str | Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Read tensors and metadata from safetensors.

    Raises:
        InputError: missing, truncated or foreign file, or values that are not finite.
    """
    path = existing(path)
    with reading(path, "safetensors"), safe_open(path, framework="pt", device="cpu") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        metadata = parse_json((file.metadata() or {}).get("neuma", "{}"), f"{path}: metadata")
        if not isinstance(metadata, dict):
            raise ValueError("the metadata are not a JSON object")
        for name, tensor in tensors.items():
            if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
                raise ValueError(f"{name} is not finite")
        return tensors, metadata


def read_torch(path: str | Path) -> Any:
    """Content of a file of torch.save: tensors, numbers and texts in plain containers; nothing else is unpickled.

    Raises:
        InputError: missing, damaged or foreign file, or one that would need more memory than its size.
    """
    path = existing(path)
    with reading(path, "a torch file of plain tensors"):
        size = path.stat().st_size
        with zipfile.ZipFile(path) as archive:  # torch writes uncompressed ZIP archives since 1.6
            members = archive.infolist()
            if sum(member.file_size for member in members) > size:
                raise ValueError("it claims more data than it has bytes")
            pickles = [zip_member(archive, info, size) for info in members if info.filename.endswith(".pkl")]
        # the only type that torch allocates at a size given in the file
        if any(b"bytearray" in content for content in pickles):
            raise ValueError("it contains a bytearray, not only plain tensors")
        return torch.load(path, map_location="cpu", weights_only=True)
