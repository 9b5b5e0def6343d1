"""Lenses with distortion, and conventions of pixels and axes.

The centre of the upper left pixel is at (0.5, 0.5), as in COLMAP and all of this project. OpenCV has it at (0, 0), so
pixels are shifted by half a pixel where they are passed to OpenCV. Cameras look along +z with x to the right and y down
(COLMAP, OpenCV). `transforms.json` has OpenGL axes (`neuma_lib.io.images`).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from neuma_lib.capture.tools import opencv
from neuma_lib.errors import InputError

HALF_PIXEL = 0.5  # offset from OpenCV's pixel coordinates to ours
COLMAP_MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}
"""COLMAP's camera models with Brown-Conrady distortion, as in OpenCV, and the order of their parameters."""
_INVERSION = (3, 100, 1e-12)
"""OpenCV's termination criteria for inverting the distortion: both, iterations, precision."""


@dataclass(frozen=True, eq=False)
class Lens:
    """Intrinsics of a camera."""

    # width, height: of its pictures [px]
    width: int
    height: int
    K: np.ndarray  # (3, 3) [px], no skew
    distortion: np.ndarray  # k1, k2, p1, p2, k3 of Brown and Conrady, as in OpenCV

    def project(self, points: np.ndarray) -> np.ndarray:
        """Project points (N, 3) in the camera's frame, z > 0, to pixels (N, 2)."""
        x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        distorted_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        distorted_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.stack([distorted_x, distorted_y], axis=1) * self.K[[0, 1], [0, 1]] + self.K[:2, 2]

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """x/z and y/z (N, 2) in the camera's frame for pixels (N, 2). Inverse of `project`."""
        cv2 = opencv()
        points = np.asarray(pixels, np.float64).reshape(-1, 1, 2)
        return cv2.undistortPointsIter(points, self.K, self.distortion, None, None, _INVERSION).reshape(-1, 2)

    def pinhole(self) -> "Lens":
        """The lens of the same size without distortion whose picture lies completely within this one's."""
        if not self.distortion.any():
            return self
        size = (self.width, self.height)
        K, _ = opencv().getOptimalNewCameraMatrix(self._opencv_K(), self.distortion, size, 0)
        K[:2, 2] += HALF_PIXEL
        return Lens(self.width, self.height, K, np.zeros(5))

    def undistort(self, image: np.ndarray) -> np.ndarray:
        """Resample an image to the lens of `pinhole`.

        Args:
            image: (H, W) or (H, W, C), uint8 or float32.
        """
        if image.shape[:2] != (self.height, self.width):
            height, width = image.shape[:2]
            problem = f"a picture of {width}x{height} does not fit the lens of {self.width}x{self.height}"
            raise InputError("image", problem)
        if not self.distortion.any():
            return image
        cv2 = opencv()
        return cv2.remap(image, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    @cached_property
    def _maps(self) -> tuple[np.ndarray, np.ndarray]:
        """Maps of `undistort`, computed once for all frames of a video."""
        target, size = self.pinhole()._opencv_K(), (self.width, self.height)
        cv2 = opencv()
        return cv2.initUndistortRectifyMap(
            self._opencv_K(), self.distortion, None, target, size, cv2.CV_32FC1
        )

    def resized(self, longest: int) -> "Lens":
        """The lens for pictures reduced to a longer side of at most ``longest`` pixels."""
        factor = min(1.0, longest / max(self.width, self.height))
        width, height = max(1, round(factor * self.width)), max(1, round(factor * self.height))
        K = self.K.copy()  # with pixel centres at +0.5, scaling needs no shift
        K[0] *= width / self.width
        K[1] *= height / self.height
        return Lens(width, height, K, self.distortion)

    def intrinsics(self) -> dict[str, float]:
        """Entries of a transforms.json, for a lens without distortion."""
        assert not self.distortion.any(), "a transforms.json contains pinhole cameras only"
        values = [*self.K[[0, 1], [0, 1]].tolist(), *self.K[:2, 2].tolist(), self.width, self.height]
        return dict(zip(("fl_x", "fl_y", "cx", "cy", "w", "h"), values))

    def plain(self) -> dict[str, Any]:
        """The lens as JSON values, read by `read_lens`."""
        names = ("k1", "k2", "p1", "p2", "k3")
        pinhole = Lens(self.width, self.height, self.K, np.zeros(5)).intrinsics()
        return {**pinhole, **dict(zip(names, self.distortion.tolist()))}

    def _opencv_K(self) -> np.ndarray:
        K = self.K.copy()
        K[:2, 2] -= HALF_PIXEL
        return K


def read_lens(values: Any, where: str) -> Lens:
    """A lens from ``fl_x``, ``fl_y``, ``cx``, ``cy``, ``w``, ``h`` and optional k1, k2, p1, p2, k3 (default 0).

    Raises:
        InputError: names ``where`` and the key.
    """
    required = ("fl_x", "fl_y", "cx", "cy", "w", "h")
    coefficients = ("k1", "k2", "p1", "p2", "k3")
    if not isinstance(values, dict):
        raise InputError(where, f"expected intrinsics {', '.join(required)} in pixels")
    for key in (*required, *coefficients):
        value = values.get(key, None if key in required else 0.0)
        if type(value) not in (int, float) or not np.isfinite(value) or (key in required and value <= 0):
            kind = "a positive number" if key in required else "a number"
            raise InputError(f"{where}: {key}", f"{value!r} must be {kind}")
    if int(values["w"]) != values["w"] or int(values["h"]) != values["h"]:
        raise InputError(f"{where}: w, h", f"{values['w']:g} x {values['h']:g} must be integers")
    K = np.array(
        [[values["fl_x"], 0, values["cx"]], [0, values["fl_y"], values["cy"]], [0, 0, 1]], np.float64
    )
    distortion = np.array([values.get(key, 0.0) for key in coefficients], np.float64)
    return Lens(int(values["w"]), int(values["h"]), K, distortion)


def lens_of_colmap(model: str, parameters: np.ndarray, width: int, height: int) -> Lens:
    """The lens of a COLMAP camera. Raises InputError for a model that is not in `COLMAP_MODELS`."""
    if model not in COLMAP_MODELS:
        raise InputError("camera model", f"{model} is not supported, only {', '.join(COLMAP_MODELS)} are")
    named = dict(zip(COLMAP_MODELS[model], np.asarray(parameters, np.float64)))
    fx, fy = named.get("fx", named.get("f")), named.get("fy", named.get("f"))
    K = np.array([[fx, 0, named["cx"]], [0, fy, named["cy"]], [0, 0, 1]])
    distortion = np.array([named.get(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3")])
    return Lens(width, height, K, distortion)
