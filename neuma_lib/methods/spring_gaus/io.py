"""Files of fitted networks of springs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.io.files import reading
from neuma_lib.io.hdf5 import check_indices
from neuma_lib.io.weights import read_weights, write_weights
from neuma_lib.methods.spring_gaus.body import SpringBody
from neuma_lib.methods.spring_gaus.network import SpringNetwork, Springs

_PARAMETERS = ("log_stiffness", "softness", "log_damping", "grip", "gap")


def save_springs(path: str | Path, body: SpringBody, springs: Springs, metadata: Mapping[str, Any]) -> None:
    """Write a network with its parameters."""
    network = body.network
    tensors = {
        "index": body.index,
        **{name: getattr(network, name) for name in ("anchors", "neighbours", "rest")},
        **{name: getattr(springs, name) for name in _PARAMETERS},
    }
    write_weights(path, tensors, {"hard": network.hard, "exponent": network.exponent, **metadata})


def load_springs(path: str | Path, like: Tensor) -> tuple[Tensor, Springs, dict[str, Any]]:
    """Springs with their network, with the dtype and device of ``like``.

    Returns:
        indices of the particles that are anchors, int64, shape (A,); the springs; the metadata of the file.

    Raises:
        InputError: missing or foreign file.
    """
    tensors, metadata = read_weights(path)
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    A, K = shapes.get("rest", (0, 0)) if len(shapes.get("rest", ())) == 2 else (0, 0)
    expected = {"index": (A,), "anchors": (A, 3), "neighbours": (A, K), "rest": (A, K)}
    expected |= dict(zip(_PARAMETERS, [(A,), *4 * [(1,)]], strict=True))
    hard, exponent = metadata.get("hard"), metadata.get("exponent")
    if shapes != expected or not A or type(hard) is not int or not isinstance(exponent, float):
        raise InputError(path, "is not a network of springs", "Run the rule fit_spring_gaus again")
    neighbours, index = tensors["neighbours"], tensors["index"]
    with reading(path, "a network of springs"):
        check_indices("neighbours", neighbours.numpy(), A)
        check_indices("index", index.numpy())
    network = SpringNetwork(tensors["anchors"], neighbours, tensors["rest"], hard, exponent)
    springs = Springs(network.to(like.dtype, like.device), 1.0, 1.0)
    with torch.no_grad():
        for name in _PARAMETERS:
            getattr(springs, name).copy_(tensors[name])
    return index.to(like.device), springs, metadata
