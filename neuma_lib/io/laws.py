"""Files of neural laws: our own ``.safetensors`` and the released NCLaw / NeuMA ``.pt``."""

from __future__ import annotations

import pickle
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.mechanics.neural import NeuralLaw, neural_law


def load_prior(path: str | Path, device: torch.device | str = "cpu") -> NeuralLaw:
    """Neural law from a file.

    Args:
        path: ``.safetensors`` as written by :func:`prior_bytes`, or ``.pt``: a dict with ``elasticity`` and
            ``plasticity``, each with the three weights of an NCLaw network.

    Raises:
        InputError: no such file, another format, missing weights or other shapes.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"prior {path}: no such file")
    if path.suffix == ".safetensors":
        try:
            with safe_open(path, framework="pt", device="cpu") as file:
                state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a mapping)
        except SafetensorError as error:
            raise InputError(
                f"prior {path}: not a readable safetensors file ({error}); make it again"
            ) from None
    elif path.suffix in (".pt", ".pth"):
        state = _released(path)
    else:
        raise InputError(f"prior {path}: expected .safetensors or .pt")
    try:
        return neural_law(state, name=path.stem).to(device)
    except InputError as error:
        raise InputError(f"prior {path}: {error}") from None


def prior_bytes(law: NeuralLaw, metadata: dict[str, str] | None = None) -> bytes:
    """Contents of a ``.safetensors`` file of the law's merged weights; the same law gives the same bytes."""
    return save({key: value.cpu() for key, value in law.prior_state().items()}, metadata)


def _released(path: Path) -> dict[str, Tensor]:
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError) as error:
        raise InputError(f"prior {path}: not a readable torch file of plain tensors ({error})") from None
    parts = {}
    for part in ("elasticity", "plasticity"):
        if not isinstance(content, dict) or not isinstance(content.get(part), dict):
            raise InputError(f"prior {path}: expected a dict with elasticity and plasticity")
        parts.update({f"{part}.{key}": value for key, value in content[part].items()})
    return parts
