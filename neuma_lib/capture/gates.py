"""Gates: the lowest quality of a reconstruction from photographs with which the next stage starts.

Later stages accept anything: a body with a chair in it moves and is fitted, too. Each gate compares one number with a
limit that good captures exceed by far, and states what to do.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from neuma_lib.capture.tools import new_figure, save_figure
from neuma_lib.errors import InputError

MIN_MEAN_IOU = 0.7
"""Mean IoU of the masks of photographs with their visual hull before they are refined. Refined masks always agree.
16 real photographs of a plush figure, of which 5 masks contain bedclothes or lack a part, have 0.78."""
BELOW_FLOOR, ABOVE_FLOOR = 0.1, 0.15
"""Distance of the lowest part of a body below and above the floor, relative to its height."""
VOLUME_RATIO = (0.6, 1.25)  # range of the volume of the surface relative to the visual hull on the floor
_QUANTILE = 0.01  # of the heights, to which single stray Gaussians do not matter
_OWN_MASKS = (
    "select the object with a box (`object` in capture.yaml), or put masks of the object alone into the folder"
    " masks/photographs, white where the object is"
)


def check_masks(ious: Sequence[float], where: str) -> None:
    """Raises InputError if masks of photographs do not show one body before they are refined.

    ``ious`` are those of each mask with the visual hull (`neuma_lib.capture.masks.agreement.agreement`).
    """
    if len(ious) > 1 and np.mean(ious) < MIN_MEAN_IOU:
        raise InputError(
            where,
            f"the masks of photographs do not show one body: their mean IoU with the common visual hull is"
            f" {np.mean(ious):.2f}, at least {MIN_MEAN_IOU} is required",
            f"Photograph the object alone, in front of a plain background of another colour, or {_OWN_MASKS}",
        )


def check_fit(psnr: float, least: float, where: str) -> None:
    """Raises InputError if the PSNR [dB] of held-out photographs inside the object is below a limit."""
    if psnr < least:
        raise InputError(
            where,
            f"the reconstruction does not predict photographs that were kept from it: {psnr:.1f} dB inside the mask,"
            f" at least {least:g} dB are required. Possible causes: surroundings in the masks, wrong poses, or"
            " an object that moved",
            "Check the contact sheet of the masks and poses.png. Photograph again with nothing moved in between, or"
            f" {_OWN_MASKS}",
        )


def check_on_floor(points: np.ndarray, floor: float, where: str) -> None:
    """Raises InputError if a body of points (N, 3), y up, does not stand on the floor at a height."""
    low, high = np.quantile(points[:, 1], [_QUANTILE, 1 - _QUANTILE])
    gap, height = low - floor, max(high - low, 1e-9)
    if gap < -BELOW_FLOOR * height or gap > ABOVE_FLOOR * height:
        side = "below" if gap < 0 else "above"
        limit = BELOW_FLOOR if gap < 0 else ABOVE_FLOOR
        raise InputError(
            where,
            f"the object does not stand on the floor: its lowest part is {abs(gap):.3f} m {side} it,"
            f" {limit * height:.3f} m are tolerated for a height of {height:.3f} m",
            "Check floor.png: the grid must lie on the surface under the object. Photograph the object on the plane of"
            f" the board or on a floor with texture. If the masks contain surroundings, {_OWN_MASKS}",
        )


def check_volume(volume: float, hull: float, watertight: bool, where: str) -> None:
    """Raises InputError if a surface is not closed, or its volume [m^3] is not about that of the visual hull."""
    low, high = VOLUME_RATIO
    ratio = volume / max(hull, 1e-300)
    if not watertight or not low <= ratio <= high:
        problem = "the volume of the surface is wrong"
        if not watertight:
            problem = "the surface of the object is not closed"
        raise InputError(
            where,
            f"{problem}: {1e3 * volume:.3f} l, the visual hull of the masks has {1e3 * hull:.3f} l, a ratio of"
            f" {low:g} to {high:g} is required",
            f"Take more photographs, from all sides and at two heights, or {_OWN_MASKS}",
        )


def draw_body(path: str | Path, parts: Mapping[str, np.ndarray], floor: float | None, title: str) -> None:
    """Plot sets of points (N, 3) [m] by name from the side and from above, with the floor."""
    figure = new_figure(12, 6)
    for axes, up, name in zip(figure.subplots(1, 2), (1, 2), ("from the side", "from above")):
        for label, points in parts.items():
            axes.scatter(points[:, 0], points[:, up], s=2, label=label, linewidths=0)
        if up == 1 and floor is not None:
            axes.axhline(floor, color="black", linewidth=1, label="floor")
        axes.set(title=name, xlabel="x [m]", ylabel=f"{'xyz'[up]} [m]", aspect="equal")
        axes.legend()
    figure.suptitle(title)
    save_figure(path, figure)
