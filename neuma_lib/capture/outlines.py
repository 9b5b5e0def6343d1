"""The outline of an object before a plate, its shadow left out.

A first mask says where the object is. Each pixel around it is then explained twice:

- by the plate, lit as in the empty picture or shaded: a shadow is one factor for all channels that changes smoothly,
  and the plate's texture shows through it (Jacques et al. 2005, Sanin et al. 2012). What other surfaces throw back on
  to the floor lights it, too, and gives a dark shadow a tint;
- by the colours of the object, learned where it flies and no shadow touches it, a little brighter or darker.

The difference of the two, with the length of the outline, has one global minimum that does not depend on the first mask
(Chan, Esedoglu and Nikolova 2006; found as by Chambolle and Pock 2011). At the edge a pixel shows both; since the plate
is known, how much of it is the object is known as well (difference matting, Qian and Sezan 1992), also where motion has
blurred it.

Shades and mixtures are those of light: pixels are sRGB, and their noise is that of levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from neuma_lib.capture.masks import box_of, component, grown, in_full, shrunk
from neuma_lib.capture.tools import opencv

NOISE = 3.0
"""Deviation between a frame and what explains it, least [levels]: noise of both, and of compression."""
MISPLACED = 0.25
"""Deviation of the camera and its compression from where it stood [px], at edges of the plate."""
DARKEST = 0.02
"""Least share of its light that a shadow leaves."""
TINT = 0.05
"""Deviation between the shades of the channels, as share of either."""
BOUNCE = 0.03
"""Deviation of the light that other surfaces throw on to the plate, as share of that of the empty picture."""
COLOURS = 24
"""Colours that an object is described with."""
LEAST_SHARE = 0.003
"""Least share that a colour counts with: what is rare costs more."""
SHADED = (6.0, 2.0)
"""Cost of a shadow, which could have many shades, against none, and of a deeper one by its negative logarithm."""
LIGHT = (0.6, 1.3)
"""How much darker and brighter the object's colours become."""
LIGHT_WEIGHT = 4.0
"""Cost of such a change, by its squared logarithm."""
UNSEEN = 40.0
"""Cost of a colour that neither side explains, in squared deviations."""
LEAST_LEARNED = 200
"""Pixels that the colours are learned from at least; with fewer, masks stay as they are."""
SMOOTH = (0.3, 2.0, 8.0)
"""Cost of the outline by its length [px], in tens of squared deviations: where the frame has a sharp edge, what is
added where it has none, and the slope that is halfway between [levels/px]."""
TELLING = 40.0
"""Difference between object and plate from which a mixture of them is told [levels]."""
_WINDOW = 5  # of the shade, which is a plane there
_TEN = 10.0
_ROUNDS = 150
_REACH = 0.3  # how far beyond the first mask the outline may lie, in radii
_AWAY = 15.0  # squared deviations from the plate of a pixel that is learned from


@dataclass(frozen=True, eq=False)
class Palette:
    """Colours of an object.

    Attributes:
        colours: sRGB, (K, 3), float32.
        shares: of them, (K,).
    """

    colours: np.ndarray
    shares: np.ndarray


@dataclass(frozen=True, eq=False)
class _ByPlate:
    """How well the plate explains a picture: squared deviations (H, W), if lit and if shaded, and that shade (H, W)."""

    lit: np.ndarray
    shaded: np.ndarray
    shade: np.ndarray

    @property
    def cost(self) -> np.ndarray:
        return np.minimum(self.lit, self.shaded)


def learn_palette(
    frames: Sequence[np.ndarray], plates: Sequence[np.ndarray], masks: Sequence[np.ndarray]
) -> Palette | None:
    """Colours of the object in frames where no shadow touches it; None where too little of it is seen.

    What the plate explains as well is not learned from: a shadow in a mask would make shadows the object's.

    Args:
        frames: RGB, uint8, (H, W, 3).
        plates: the empty scene at the exposure of each frame, float32, (H, W, 3).
        masks: first ones, Boolean, (H, W).
    """
    cv2 = opencv()
    seen = [np.empty((0, 3), np.float32)]
    for frame, plate, mask in zip(frames, plates, masks):
        if mask.any():
            box = box_of(mask, _WINDOW)
            picture = frame[box].astype(np.float32)
            inside = shrunk(mask, max(1, round(0.1 * _radius(mask))))[box]
            seen.append(picture[inside & (_by_plate(picture, plate[box]).cost > _AWAY)])
    pixels = np.concatenate(seen)
    if len(pixels) < LEAST_LEARNED:
        return None
    rng = np.random.default_rng(0)
    pixels = pixels[rng.choice(len(pixels), min(len(pixels), 20_000), replace=False)]
    cv2.setRNGSeed(0)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.5)
    _, labels, colours = cv2.kmeans(pixels, COLOURS, None, criteria, 2, cv2.KMEANS_PP_CENTERS)
    return Palette(colours, np.bincount(labels.ravel(), minlength=COLOURS) / len(labels))


def outline(frame: np.ndarray, plate: np.ndarray, mask: np.ndarray, palette: Palette) -> np.ndarray:
    """The mask of the object, (H, W), near a first one that may have shadows in it.

    Args:
        frame: RGB, uint8, (H, W, 3).
        plate: the empty scene at its exposure, float32, (H, W, 3).
        mask: the first one, not empty.
    """
    reach = max(3, round(_REACH * _radius(mask)))
    box = box_of(mask, reach + _WINDOW)
    picture, empty = frame[box].astype(np.float32), plate[box]
    background = _by_plate(picture, empty)
    difference = _by_palette(picture, palette) - np.minimum(background.cost, UNSEEN)
    inside = cheapest(np.where(grown(mask[box], reach), difference, 0.5 * UNSEEN), picture)
    if inside.any():
        inside = _mixed(picture, empty, background.shade, inside)
    return in_full(component(inside), box, mask.shape)


def _radius(mask: np.ndarray) -> float:
    return float(np.sqrt(mask.sum() / np.pi))


def linear(levels: np.ndarray) -> np.ndarray:
    """Light, from 0 to 1, of sRGB levels, from 0 to 255 (IEC 61966-2-1), float32."""
    v = np.clip(levels, 0, 255) / np.float32(255)
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4).astype(np.float32)


def coded(light: np.ndarray) -> np.ndarray:
    """sRGB levels, from 0 to 255, of light, float32."""
    light = np.maximum(light, 0)
    v = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (255 * v).astype(np.float32)


def _levels_by_light(light: np.ndarray) -> np.ndarray:
    """Derivative of `coded`."""
    slope = 1.055 / 2.4 * np.maximum(light, 0.0031308) ** (1 / 2.4 - 1)
    return 255 * np.where(light <= 0.0031308, 12.92, slope).astype(np.float32)


def _by_plate(picture: np.ndarray, plate: np.ndarray) -> _ByPlate:
    """How well a plate, lit or shaded, explains a picture; both float32, (H, W, 3).

    The logarithm of a shade is a plane in a window. Of the nine windows that hold a pixel that one counts which is
    explained best, as at the edge of the object only those on one side are of one thing (Kuwahara et al. 1976).
    """
    cv2 = opencv()
    plate = np.maximum(plate, 1.0)
    light, full = linear(picture), linear(plate)
    edges = MISPLACED * np.hypot(
        *(cv2.Sobel(plate, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1)))
    )
    lit = ((picture - plate) ** 2 / (NOISE**2 + edges**2 + (0.4 * TINT * plate) ** 2)).sum(axis=2)

    def window(values: np.ndarray, side: int = _WINDOW) -> np.ndarray:
        return cv2.blur(values, (side, side), borderType=cv2.BORDER_REFLECT_101)

    def shifted(values: np.ndarray, x: int, y: int) -> np.ndarray:
        by = np.float32([[1, 0, x], [0, 1, y]])
        return cv2.warpAffine(values, by, values.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)

    def explained(log: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        shade = np.exp(np.clip(log, np.log(DARKEST), 0.0))[..., None]
        expected = shade * full
        slope = _levels_by_light(expected)
        variance = NOISE**2 + (slope * BOUNCE * full) ** 2 + (slope * TINT * expected) ** 2
        variance += (edges * shade ** (1 / 2.4)) ** 2
        return ((picture - coded(expected)) ** 2 / variance).sum(axis=2), shade[..., 0]

    products = (window((pair).sum(axis=2), 3) for pair in (light * full, full * full))
    log = np.log(np.clip(np.divide(*products), DARKEST, 1.5))
    half = _WINDOW // 2
    ramp = np.tile(np.arange(-half, half + 1, dtype=np.float32), (_WINDOW, 1))
    ramp /= (ramp * ramp).sum()
    level, along, down = (
        window(log),
        *(cv2.filter2D(log, cv2.CV_32F, k, borderType=cv2.BORDER_REFLECT_101) for k in (ramp, ramp.T)),
    )
    residual = window(explained(level)[0])
    best = np.full(log.shape, np.inf, np.float32)
    cost, shade = np.empty_like(best), np.empty_like(best)
    for x in (-half, 0, half):
        for y in (-half, 0, half):
            plane = shifted(level, x, y) + shifted(along, x, y) * x + shifted(down, x, y) * y
            own, factor = explained(plane)
            whole = 0.5 * (own + shifted(residual, x, y))
            better = whole < best
            best[better], cost[better], shade[better] = whole[better], own[better], factor[better]
    return _ByPlate(lit, np.maximum(cost, best) + SHADED[0] - SHADED[1] * np.log(shade), shade)


def _by_palette(picture: np.ndarray, palette: Palette) -> np.ndarray:
    """Squared deviations (H, W) from the nearest colour, at most `UNSEEN`; rare colours cost a little more."""
    light = linear(picture)
    best = np.full(picture.shape[:2], UNSEEN, np.float32)
    for colour, share in zip(palette.colours, palette.shares):
        own = linear(colour)
        factor = np.clip((light @ own) / max(own @ own, 1e-9), *LIGHT)[..., None]
        expected = factor * own
        variance = 2 * NOISE**2 + (TINT * _levels_by_light(expected) * expected) ** 2
        cost = ((picture - coded(expected)) ** 2 / variance).sum(axis=2)
        cost += LIGHT_WEIGHT * np.log(factor[..., 0]) ** 2 - 2 * np.log(max(share, LEAST_SHARE))
        np.minimum(best, cost, out=best)
    return best


def cheapest(cost: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """The region (H, W) with the least sum of what its pixels cost and of its outline, which is cheap along edges.

    Args:
        cost: of a pixel inside over one outside, in squared deviations, (H, W).
        picture: in which edges are looked for, float32, (H, W, 3).
    """
    cv2 = opencv()
    grey = picture.mean(axis=2)
    slope = np.hypot(*(cv2.Sobel(grey, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1))))
    least, more, half = SMOOTH
    return _least_cost((cost / _TEN).astype(np.float32), least + more / (1 + (slope / half) ** 2))


def _least_cost(cost: np.ndarray, length: np.ndarray) -> np.ndarray:
    """The region (H, W) with the least sum of costs inside and of lengths along its outline.

    The minimum over u in [0, 1] of sum(length |grad u| + cost u), cut at a half, is that region (Chan et al. 2006).
    """
    u = (cost < 0).astype(np.float32)
    ahead, x, y = u, np.zeros_like(u), np.zeros_like(u)
    step = np.float32(1 / np.sqrt(8))
    for _ in range(_ROUNDS):
        x[:, :-1] += step * np.diff(ahead, axis=1)
        y[:-1] += step * np.diff(ahead, axis=0)
        over = np.maximum(1, np.sqrt(x * x + y * y) / length)
        x /= over
        y /= over
        divergence = x + y
        divergence[:, 1:] -= x[:, :-1]
        divergence[1:] -= y[:-1]
        new = np.clip(u + step * (divergence - cost), 0, 1)
        ahead, u = 2 * new - u, new
    return u > 0.5


def _mixed(picture: np.ndarray, plate: np.ndarray, shade: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """The region whose pixels at the edge are at least half the object's, where that is told."""
    cv2 = opencv()
    sure, away = shrunk(inside, 2).astype(np.float32), 1 - grown(inside, 2).astype(np.float32)
    band = grown(inside, 1) & ~shrunk(inside, 1)

    def near(values: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        weight = cv2.GaussianBlur(weights, (0, 0), 2.0)
        summed = cv2.GaussianBlur(values * weights[..., None], (0, 0), 2.0).reshape(values.shape)
        return summed / np.maximum(weight, 1e-6)[..., None], weight > 1e-4

    light = linear(picture)
    own, known = near(light, sure)
    log, shaded = near(np.log(shade)[..., None], away)
    behind = linear(plate) * np.where(shaded[..., None], np.exp(log), 1.0)
    told = band & known & (((coded(own) - coded(behind)) ** 2).sum(axis=2) > TELLING**2)
    towards = own - behind
    share = ((light - behind) * towards).sum(axis=2) / np.maximum((towards**2).sum(axis=2), 1e-9)
    mixed = np.where(told, np.clip(share, 0, 1), inside).astype(np.float32)
    return cv2.GaussianBlur(mixed, (0, 0), 0.6) > 0.5
