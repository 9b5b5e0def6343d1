"""Segment an object in front of a known background, without its shadow.

An initial mask localises the object. Two models explain each pixel near it:

- the background, lit as in the empty picture or shaded. A shadow is a smooth factor common to all channels that keeps
  the background's texture (Jacques et al. 2005, Sanin et al. 2012). Light reflected by other surfaces may tint it.
- the colours of the object, slightly brighter or darker, learned in free flight, where no shadow touches it.

The difference of the two costs plus the length of the outline has a global minimum that does not depend on the initial
mask (Chan, Esedoglu and Nikolova 2006; minimised as in Chambolle and Pock 2011). A pixel at the edge, possibly with
motion blur, is a mixture whose coverage follows from the known background (difference matting, Qian and Sezan 1992).

Shading and mixing are computed in linear light, noise in sRGB levels.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from neuma_lib.capture.masks.regions import box_of, component, grown, in_full, radius_of, shrunk
from neuma_lib.capture.tools import opencv

NOISE = 3.0
"""Minimum standard deviation between a frame and a model: noise of both, and compression [levels]."""
POSE_TOLERANCE = 0.25
"""Standard deviation of the background's position in the picture [px], relevant at its edges."""
_DARKEST = 0.02  # minimum share of the light that a shadow leaves
_TINT = 0.05  # relative standard deviation between the shades of the channels
BOUNCE = 0.03
"""Standard deviation of light reflected by other surfaces, as share of the light in the empty picture."""
_COLOURS = 24  # number of colours that describe an object
MIN_SHARE = 0.003
"""Minimum share assumed for a colour. Rare colours cost more."""
SHADED = (6.0, 2.0)
"""Cost of a shadow, which has many possible shades, and of its depth by the negative logarithm of the shade."""
_LIGHT = (0.6, 1.3)  # range of brightness of the object's colours
_LIGHT_WEIGHT = 4.0  # cost of such a change, by its squared logarithm
UNSEEN = 40.0
"""Cost of a colour that neither model explains, in squared standard deviations."""
MIN_LEARNED = 200
"""Pixels required to learn the colours. With fewer, masks are not changed."""
SMOOTH = (0.3, 2.0, 8.0)
"""Cost of the outline by its length [px], in tens of squared deviations: at a sharp edge of the frame, the addition
where there is none, and the slope halfway between [levels/px]."""
MIN_CONTRAST = 40.0
"""Difference between object and background required to determine their mixture [levels]."""
_WINDOW = 5  # in which the logarithm of the shade is a plane
_TEN = 10.0
_ROUNDS = 150
_REACH = 0.3  # distance of the outline from the initial mask, in radii
_AWAY = 15.0  # squared deviations from the background required of a pixel for learning


@dataclass(frozen=True, eq=False)
class Palette:
    """Colours of an object, sRGB (K, 3), float32, and their relative frequencies (K,)."""

    colours: np.ndarray
    shares: np.ndarray


@dataclass(frozen=True, eq=False)
class _BackgroundFit:
    """Squared deviations (H, W) of a picture from the lit and the shaded background, and the shade (H, W)."""

    lit: np.ndarray
    shaded: np.ndarray
    shade: np.ndarray

    @property
    def cost(self) -> np.ndarray:
        return np.minimum(self.lit, self.shaded)


def learn_palette(views: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Palette | None:
    """Learn the colours of the object from frames in which no shadow touches it. None if there are too few pixels.

    Pixels that the background also explains are left out, so that shadows in a mask do not become object colours.

    Args:
        views: frames, RGB, uint8, (H, W, 3); the empty scene at the exposure of each, float32, (H, W, 3); and initial
            masks, Boolean, (H, W).
    """
    cv2 = opencv()
    seen = [np.empty((0, 3), np.float32)]
    for frame, background, mask in views:
        if mask.any():
            box = box_of(mask, _WINDOW)
            picture = frame[box].astype(np.float32)
            inside = shrunk(mask, max(1, round(0.1 * radius_of(mask))))[box]
            seen.append(picture[inside & (_explain_by_background(picture, background[box]).cost > _AWAY)])
    pixels = np.concatenate(seen)
    if len(pixels) < MIN_LEARNED:
        return None
    rng = np.random.default_rng(0)
    pixels = pixels[rng.choice(len(pixels), min(len(pixels), 20_000), replace=False)]
    cv2.setRNGSeed(0)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.5)
    _, labels, colours = cv2.kmeans(pixels, _COLOURS, None, criteria, 2, cv2.KMEANS_PP_CENTERS)
    return Palette(colours, np.bincount(labels.ravel(), minlength=_COLOURS) / len(labels))


def silhouette(frame: np.ndarray, background: np.ndarray, mask: np.ndarray, palette: Palette) -> np.ndarray:
    """Mask of the object, (H, W), from an initial mask that may contain shadows.

    Args:
        frame: RGB, uint8, (H, W, 3).
        background: the empty scene at its exposure, float32, (H, W, 3).
        mask: the initial one, not empty.
    """
    reach = max(3, round(_REACH * radius_of(mask)))
    box = box_of(mask, reach + _WINDOW)
    picture, empty = frame[box].astype(np.float32), background[box]
    fit = _explain_by_background(picture, empty)
    difference = _palette_cost(picture, palette) - np.minimum(fit.cost, UNSEEN)
    inside = cheapest(np.where(grown(mask[box], reach), difference, 0.5 * UNSEEN), picture)
    if inside.any():
        inside = _mixed(picture, empty, fit.shade, inside)
    return in_full(component(inside), box, mask.shape)


def linear(levels: np.ndarray) -> np.ndarray:
    """Linear light in [0, 1] from sRGB levels in [0, 255] (IEC 61966-2-1), float32."""
    v = np.clip(levels, 0, 255) / np.float32(255)
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4).astype(np.float32)


def coded(light: np.ndarray) -> np.ndarray:
    """sRGB levels in [0, 255] from linear light, float32."""
    light = np.maximum(light, 0)
    v = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (255 * v).astype(np.float32)


def _levels_by_light(light: np.ndarray) -> np.ndarray:
    """Derivative of `coded`."""
    slope = 1.055 / 2.4 * np.maximum(light, 0.0031308) ** (1 / 2.4 - 1)
    return 255 * np.where(light <= 0.0031308, 12.92, slope).astype(np.float32)


def _explain_by_background(picture: np.ndarray, background: np.ndarray) -> _BackgroundFit:
    """Fit a background, lit or shaded, to a picture, both float32, (H, W, 3).

    The logarithm of a shade is a plane within a window. The best of nine windows around a pixel counts, since at the
    edge of the object only windows on one side are uniform (Kuwahara et al. 1976).
    """
    cv2 = opencv()
    background = np.maximum(background, 1.0)
    light, full = linear(picture), linear(background)
    edges = POSE_TOLERANCE * np.hypot(
        *(cv2.Sobel(background, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1)))
    )
    lit = ((picture - background) ** 2 / (NOISE**2 + edges**2 + (0.4 * _TINT * background) ** 2)).sum(axis=2)

    def window(values: np.ndarray, side: int = _WINDOW) -> np.ndarray:
        return cv2.blur(values, (side, side), borderType=cv2.BORDER_REFLECT_101)

    def shifted(values: np.ndarray, x: int, y: int) -> np.ndarray:
        by = np.float32([[1, 0, x], [0, 1, y]])
        return cv2.warpAffine(values, by, values.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)

    def explained(log: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        shade = np.exp(np.clip(log, np.log(_DARKEST), 0.0))[..., None]
        expected = shade * full
        slope = _levels_by_light(expected)
        variance = NOISE**2 + (slope * BOUNCE * full) ** 2 + (slope * _TINT * expected) ** 2
        variance += (edges * shade ** (1 / 2.4)) ** 2
        return ((picture - coded(expected)) ** 2 / variance).sum(axis=2), shade[..., 0]

    products = (window((pair).sum(axis=2), 3) for pair in (light * full, full * full))
    log = np.log(np.clip(np.divide(*products), _DARKEST, 1.5))
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
    return _BackgroundFit(lit, np.maximum(cost, best) + SHADED[0] - SHADED[1] * np.log(shade), shade)


def _palette_cost(picture: np.ndarray, palette: Palette) -> np.ndarray:
    """Squared deviations (H, W) from the nearest colour, at most `UNSEEN`. Rare colours cost slightly more."""
    light = linear(picture)
    best = np.full(picture.shape[:2], UNSEEN, np.float32)
    for colour, share in zip(palette.colours, palette.shares):
        own = linear(colour)
        factor = np.clip((light @ own) / max(own @ own, 1e-9), *_LIGHT)[..., None]
        expected = factor * own
        variance = 2 * NOISE**2 + (_TINT * _levels_by_light(expected) * expected) ** 2
        cost = ((picture - coded(expected)) ** 2 / variance).sum(axis=2)
        cost += _LIGHT_WEIGHT * np.log(factor[..., 0]) ** 2 - 2 * np.log(max(share, MIN_SHARE))
        np.minimum(best, cost, out=best)
    return best


def cheapest(cost: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """The region (H, W) with the minimum total cost of its pixels and its outline, which is cheap along edges.

    Args:
        cost: of a pixel inside relative to outside, in squared deviations, (H, W).
        picture: whose edges attract the outline, float32, (H, W, 3).
    """
    cv2 = opencv()
    grey = picture.mean(axis=2)
    slope = np.hypot(*(cv2.Sobel(grey, cv2.CV_32F, *axis, scale=1 / 8) for axis in ((1, 0), (0, 1))))
    least, more, half = SMOOTH
    return _minimum_cost((cost / _TEN).astype(np.float32), least + more / (1 + (slope / half) ** 2))


def _minimum_cost(cost: np.ndarray, length: np.ndarray) -> np.ndarray:
    """The region (H, W) with the minimum sum of costs inside and of length weights along its outline.

    It is the minimum over u in [0, 1] of sum(length |grad u| + cost u), thresholded at 1/2 (Chan et al. 2006).
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


def _mixed(picture: np.ndarray, background: np.ndarray, shade: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Move the edge of a region to the pixels with at least half coverage, where contrast is sufficient."""
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
    behind = linear(background) * np.where(shaded[..., None], np.exp(log), 1.0)
    decided = band & known & (((coded(own) - coded(behind)) ** 2).sum(axis=2) > MIN_CONTRAST**2)
    towards = own - behind
    share = ((light - behind) * towards).sum(axis=2) / np.maximum((towards**2).sum(axis=2), 1e-9)
    mixed = np.where(decided, np.clip(share, 0, 1), inside).astype(np.float32)
    return cv2.GaussianBlur(mixed, (0, 0), 0.6) > 0.5
