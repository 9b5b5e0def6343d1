"""A law of two networks, from the file of `neuma law export`, with numpy alone."""

import json
import math

import numpy as np

LAYERS = ("layers.0.fc.weight", "layers.1.fc.weight", "final_layer.fc.weight")
gelu = np.vectorize(lambda z: 0.5 * z * (1 + math.erf(z / math.sqrt(2))), otypes=[float])


def read(path):
    """Arrays and metadata of a .safetensors file: the length of a header, the header (JSON), numbers."""
    data = open(path, "rb").read()
    start = 8 + int.from_bytes(data[:8], "little")
    header, data = json.loads(data[8:start]), data[start:]
    about = json.loads(header.pop("__metadata__")["neuma"])
    numbers = {name: np.frombuffer(data[slice(*x["data_offsets"])], "<f4") for name, x in header.items()}
    return {name: numbers[name].reshape(x["shape"]) for name, x in header.items()}, about


def svd(F):
    """U, sigma, Vh of F (N, 3, 3), with U Vh a rotation and the sign of det F in the last singular value."""
    U, sigma, Vh = np.linalg.svd(F)
    signs = np.where(np.linalg.det(F)[:, None] < 0, (1, 1, -1), 1)
    return U * signs[:, None], sigma * signs, Vh


def load(path):
    """Elasticity, F (N, 3, 3) -> Kirchhoff stress [Pa], plasticity, trial F -> F once a time step, and metadata."""
    arrays, about = read(path)
    if about["export"]["kind"] != "networks" or "rank" in about:
        raise SystemExit(f"{path} is no pair of networks: see isotropic_in_numpy.py, or leave out --apart")
    W_e, W_p = ([arrays[f"{part}.{layer}"] for layer in LAYERS] for part in ("elasticity", "plasticity"))
    stress = lambda F: network(F, W_e) @ F.swapaxes(1, 2)  # noqa: E731
    return stress, lambda F: F + 1e-3 * network(F, W_p), about["export"]


def network(F, W):
    """R X (N, 3, 3): the rotation of F, and the symmetric output of a network that reads invariants of F."""
    U, sigma, Vh = svd(F)
    strain = (F.swapaxes(1, 2) @ F - np.eye(3)).reshape(-1, 9)
    z = np.concatenate([sigma - 1, strain, np.linalg.det(F)[:, None] - 1], axis=1)
    z = gelu(gelu(z @ W[0].T) @ W[1].T)
    Y = (z @ W[2].T).reshape(-1, 3, 3)
    return U @ Vh @ (Y + Y.swapaxes(1, 2)) / 2
