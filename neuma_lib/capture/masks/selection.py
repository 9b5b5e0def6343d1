"""Masks of an object that is selected by a box or a point in one or several photographs of a cluttered room.

A box in one photograph also contains what is behind the object. The other photographs decide. Each voxel near the
object collects evidence (compare Campbell et al. 2010 and Kolev et al. 2009):

- It is not the object if it projects outside a box, lies below the floor, or lies between a camera and a point of the
  reconstruction that this camera sees.
- The colour of its pixel in each photograph is that of the object, or of the surroundings in this photograph, which
  the object's shadow darkens. GrabCut in the box is the first estimate. Then colours and voxels are estimated in turn.
- A network for salient objects sees only the part of each photograph that shows the voxels.

The mean over the photographs and over neighbouring voxels decides. One photograph against the object counts more than
one for it, as in a visual hull, but is bounded, because something may stand in front of the object.

A point becomes a box first: masks of some photographs are estimated from a box around the point, which then moves to
the sides of the mask, or beyond where the mask reaches it, until both agree.

Pictures are RGB, uint8, (H, W, 3). Masks are Boolean, (H, W).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from neuma_lib.capture.calibration.lens import Lens
from neuma_lib.capture.calibration.placement import camera_centres
from neuma_lib.capture.calibration.vertical import UP
from neuma_lib.capture.masks.agreement import projected
from neuma_lib.capture.masks.mask_refinement import colour_bins, colour_shares, log_ratio
from neuma_lib.capture.masks.regions import component, grabcut, grown, radius_of, shrunk
from neuma_lib.capture.masks.silhouettes import UNSEEN, cheapest
from neuma_lib.capture.pictures import sensor_pixels
from neuma_lib.capture.tools import opencv
from neuma_lib.errors import InputError

MIN_FILLED = 0.8
"""Share of the width and of the height of a box that the selected object must fill."""
_MIN_POINTS = 3  # points of the reconstruction that locate a box in depth
_MIDDLE = 0.6  # part of a box in which they are, its border often shows what is behind
_ON_FLOOR = 0.15  # height up to which a point may be one of the floor, in half boxes
_DEPTH = 0.3  # distance from the surface of the object to its centre, in half boxes
_SUNK = 0.05  # share of the points near the object that are below the floor if it is none, but a bed
_REACH = 1.4  # half side of the cube of voxels, in half boxes
_VOXELS = 56  # along a side of the cube
_SIDE = 224  # longer side of the part of a photograph that shows the cube [px]
_MAX_ENLARGED = 2.0
_ROUNDS = 5  # iterations of voxels and colours
_FOR, _AGAINST = 1.0, 2.5  # bounds of the evidence of one photograph
_MAX_COLOUR, _MAX_SALIENT = 5.0, 2.0  # bounds of log-likelihood ratios
_MAX_RAYS = 3.0  # smoothed number of rays through a voxel that make it empty
_MIN_VIEWS = 0.3  # share of the photographs that must show a voxel
_CERTAIN, _EDGE = 0.06, 0.1  # distance from the silhouette of certain pixels and of the edge, in radii
_TRIMMED = 0.15  # share of the photographs that does not count for a colour
_AWAY, _MIN_AROUND = 1.15, 200  # distance in half boxes, and number, of pixels that show the surroundings
_STIFF = 8.0  # cost of an edge at the limit of this distance
_SHADED = 0.1  # share of the surroundings that is in the object's shadow
_SHADES = (0.25, 0.4, 0.6, 0.8)  # brightness there, relative to that without shadow
_OCCLUDED = -2.5  # log-likelihood ratio of the colours of something in front of the object


_GUESS = 0.15  # half side of the first box around a point, as share of the longer side of the photograph
_POINT_ROUNDS, _POINT_VIEWS = 6, 10  # boxes that are tried for a point, and photographs that decide on them
_GROWTH = 0.3  # of a side that the mask reaches, in sides of the box
_MARGIN, _SETTLED = 0.04, 0.85  # of the next box, in sides, and share of a box that its mask fills at the end


@dataclass(frozen=True, eq=False)
class Box:
    """A rectangle around the object in a photograph.

    Attributes:
        lower, upper: corners (x, y) [px], (2,) each.
        guessed: whether it is a first guess around a point on the object.
    """

    lower: np.ndarray
    upper: np.ndarray
    guessed: bool = False

    @property
    def middle(self) -> np.ndarray:
        return (self.lower + self.upper) / 2

    @property
    def half(self) -> np.ndarray:
        """Half of its width and height."""
        return (self.upper - self.lower) / 2


@dataclass(eq=False)
class _View:
    """The part of a photograph that shows the voxels.

    Attributes:
        number: of the photograph.
        pixels: resampled, (h, w, 3).
        K: its intrinsics, (3, 3).
        lower, upper: corners in the photograph [px], (2,).
        voxels: numbers of the voxels in it, (n,).
        rows, columns: of these voxels, (n,).
        salient: log-likelihood ratio of the network, (h, w).
        colour: log-likelihood ratio of the colours, (h, w).
    """

    number: int
    pixels: np.ndarray
    K: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    voxels: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    salient: np.ndarray
    colour: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def evidence(self) -> np.ndarray:
        return self.colour + self.salient


def box_in(rectangle: Sequence[float], orientation: int | None, lens: Lens, K: np.ndarray) -> Box:
    """Box in an undistorted photograph.

    Args:
        rectangle: left, upper, right, lower in the displayed photograph [px], or x and y of a point on the object.
        orientation: of `neuma_lib.capture.pictures.orientation_of`.
        lens: of the photograph.
        K: intrinsics of the undistorted one, (3, 3).
    """
    if len(rectangle) == 2:
        (pixels,) = sensor_pixels(np.array([rectangle], float), orientation, (lens.width, lens.height))
        place = lens.directions(pixels[None])[0] * K[[0, 1], [0, 1]] + K[:2, 2]
        half = _GUESS * 2 * K[:2, 2].max()
        return Box(place - half, place + half, guessed=True)
    x0, y0, x1, y1 = rectangle
    ticks = np.linspace(0, 1, 9)
    x, y = x0 + (x1 - x0) * ticks, y0 + (y1 - y0) * ticks
    border = [(x, np.full(9, y0)), (x, np.full(9, y1)), (np.full(9, x0), y), (np.full(9, x1), y)]
    displayed = np.concatenate([np.stack(side, axis=1) for side in border])
    directions = lens.directions(sensor_pixels(displayed, orientation, (lens.width, lens.height)))
    places = directions * K[[0, 1], [0, 1]] + K[:2, 2]
    return Box(places.min(axis=0), places.max(axis=0))


def selected_masks(
    pictures: Sequence[np.ndarray],
    viewmats: np.ndarray,
    Ks: np.ndarray,
    boxes: Mapping[int, Box],
    points: np.ndarray,
    seen: np.ndarray,
    saliency: Callable[[np.ndarray], np.ndarray],
    name: str,
    floor: float,
    progress: Callable[[int, int], None] | None = None,
) -> list[np.ndarray]:
    """Masks of the object in a box in all N >= 2 photographs. Empty where a photograph does not show it.

    Args:
        pictures: the photographs.
        viewmats: world to camera, OpenCV axes, (N, 4, 4).
        Ks: [px], pixel centres at +0.5, (N, 3, 3).
        boxes: tight boxes or guesses by number of the photograph, at least one.
        points: of the reconstruction, (P, 3).
        seen: which points each photograph shows, Boolean, (N, P).
        saliency: `neuma_lib.capture.masks.saliency.Saliency`, or another function that returns (H, W) in [0, 1].
        name: of the capture for messages.
        floor: height y of the plane on which the object rests. If points near it are lower, as on a bed, it may
            be lower too.
        progress: called with the numbers of finished and of all steps.

    Raises:
        InputError: a box contains no object, or does not fit the object that the other photographs show.
    """
    chosen = {}
    for i, box in boxes.items():
        if box.guessed:
            box = _fitted(i, box, pictures, viewmats, Ks, points, seen, saliency, name, floor)
        chosen[i] = box
    masks = _masks(pictures, viewmats, Ks, chosen, points, seen, saliency, name, floor, progress)
    for i, box in chosen.items():
        _check_filled(masks[i], box, f"{name}, photograph {i + 1}")
    return masks


def _fitted(
    number: int,
    box: Box,
    pictures: Sequence[np.ndarray],
    viewmats: np.ndarray,
    Ks: np.ndarray,
    points: np.ndarray,
    seen: np.ndarray,
    saliency: Callable[[np.ndarray], np.ndarray],
    name: str,
    floor: float,
) -> Box:
    """The box around the object at the middle of a guessed one. Arguments are those of `selected_masks`."""
    others = [i for i in range(len(pictures)) if i != number]
    used = [number, *others[:: max(1, -(-len(others) // _POINT_VIEWS))]]
    some, views, intrinsics = [pictures[i] for i in used], viewmats[used], Ks[used]
    size = np.array(pictures[number].shape[1::-1], float)
    for _ in range(_POINT_ROUNDS):
        box = Box(np.clip(box.lower, 0, size), np.clip(box.upper, 0, size))
        mask = _masks(some, views, intrinsics, {0: box}, points, seen[used], saliency, name, floor)[0]
        rows, columns = np.nonzero(mask)
        if not len(rows):
            break
        lower, upper = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()]) + 1.0
        left, right = (lower <= box.lower + 1) & (lower > 0), (upper >= box.upper - 1) & (upper < size)
        if not (left | right).any() and ((upper - lower) / (2 * box.half)).min() > _SETTLED:
            break
        growth, margin = 2 * _GROWTH * box.half, _MARGIN * (upper - lower)
        box = Box(lower - np.where(left, growth, margin), upper + np.where(right, growth, margin))
    return box


def _masks(
    pictures: Sequence[np.ndarray],
    viewmats: np.ndarray,
    Ks: np.ndarray,
    boxes: Mapping[int, Box],
    points: np.ndarray,
    seen: np.ndarray,
    saliency: Callable[[np.ndarray], np.ndarray],
    name: str,
    floor: float,
    progress: Callable[[int, int], None] | None = None,
) -> list[np.ndarray]:
    """Masks of `selected_masks`, from boxes only, which they need not fill."""
    located = locate(viewmats, Ks, boxes, points, seen, (np.array([0, floor, 0.0]), np.array(UP)))
    if located is None:
        raise InputError(
            name,
            "neither points of the reconstruction nor the floor determine the distance of the object in the box",
            "Draw the box in a photograph that looks down at the object",
        )
    centre, size = located
    half = _REACH * size
    ticks = ((np.arange(_VOXELS) + 0.5) / _VOXELS * 2 - 1) * half
    voxels = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3) + centre
    voxel = 2 * half / _VOXELS
    heights = points[np.hypot(*(points - centre)[:, [0, 2]].T) < size, 1]
    sunk = len(heights) > 0 and np.quantile(heights, _SUNK) < floor - voxel / 2
    allowed = np.ones(len(voxels), bool) if sunk else voxels[:, 1] > floor
    for i, box in boxes.items():
        pixels, depth = projected(voxels, viewmats[i], Ks[i])
        allowed &= (depth > 0) & ((pixels >= box.lower) & (pixels <= box.upper)).all(axis=1)
    total = len(pictures) + _ROUNDS
    views = []
    for i, picture in enumerate(pictures):
        view = _view(i, picture, viewmats[i], Ks[i], centre, half, voxels, saliency)
        if view is not None:
            views.append(view)
        if progress:
            progress(i + 1, total)
    _learn_from_boxes(views, viewmats, boxes, centre, size)
    empty = np.minimum(_sight_rays(voxels, voxel, viewmats, points, seen) / _MAX_RAYS, 1)
    for done in range(_ROUNDS + 1):
        body = voxels[_body(views, allowed, empty, name)]
        silhouettes = [_silhouette(view, body, voxel, viewmats[view.number]) for view in views]
        if done < _ROUNDS:
            _learn(views, silhouettes)
        if progress:
            progress(min(len(pictures) + done + 1, total), total)
    masks = [np.zeros(picture.shape[:2], bool) for picture in pictures]
    for view, silhouette in zip(views, silhouettes):
        masks[view.number] = _segment(view, silhouette, masks[view.number].shape)
    return masks


def locate(
    viewmats: np.ndarray,
    Ks: np.ndarray,
    boxes: Mapping[int, Box],
    points: np.ndarray,
    seen: np.ndarray,
    floor: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, float] | None:
    """Centre (3,) of the object, and half of the longer side of its box.

    The points that a boxed photograph shows give its distance. If those above the floor are too few, as on an object
    without texture, the object is a ball in its box that touches the floor.

    Args:
        viewmats, Ks, boxes, points, seen: as those of `selected_masks`.
        floor: a point of the plane under the object (3,), and its unit normal (3,). None: unknown.

    Returns:
        None if neither points nor the floor determine the distance.
    """
    centres, sizes, eyes = [], [], camera_centres(viewmats)
    for i, box in boxes.items():
        pixels, depth = projected(points, viewmats[i], Ks[i])
        inside = seen[i] & (depth > 0) & (np.abs((pixels - box.middle) / box.half) < _MIDDLE).all(axis=1)
        focal = Ks[i][[0, 1], [0, 1]]
        half, middle = box.half / focal, (box.middle - Ks[i][:2, 2]) / focal
        ray, resting = viewmats[i][:3, :3].T @ np.append(middle, 1.0), np.nan
        if floor is not None:
            above = viewmats[i][:3, :3] @ floor[1]
            up = above[:2] - middle * above[2]  # in the picture
            radius = np.linalg.norm(half * up / np.linalg.norm(up))
            resting = (eyes[i] - floor[0]) @ floor[1] / max(radius - ray @ floor[1], 1e-9)
            inside &= (points - floor[0]) @ floor[1] > _ON_FLOOR * resting * half.max()
        if inside.sum() >= _MIN_POINTS:
            near = float(np.median(depth[inside]))
            sizes.append(near * float(half.max()))
            centres.append(eyes[i] + (near + _DEPTH * sizes[-1]) * ray)
        elif resting > 0:
            sizes.append(float(resting * half.max()))
            centres.append(eyes[i] + resting * ray)
    return (np.mean(centres, axis=0), float(np.mean(sizes))) if centres else None


def _view(
    number: int,
    picture: np.ndarray,
    viewmat: np.ndarray,
    K: np.ndarray,
    centre: np.ndarray,
    half: float,
    voxels: np.ndarray,
    saliency: Callable[[np.ndarray], np.ndarray],
) -> _View | None:
    """None if the cube around the object is not in the picture."""
    cv2 = opencv()
    whole = np.array(picture.shape[1::-1])
    corners, depth = projected(centre + half * (2.0 * np.array(list(np.ndindex(2, 2, 2))) - 1), viewmat, K)
    if (depth <= 0).all():
        return None
    if (depth <= 0).any():
        corners = np.array([np.zeros(2), whole])
    lower = np.clip(np.floor(corners.min(axis=0)), 0, whole).astype(int)
    upper = np.clip(np.ceil(corners.max(axis=0)), 0, whole).astype(int)
    if (upper - lower).min() < 16:
        return None
    scale = min(_SIDE / (upper - lower).max(), _MAX_ENLARGED)
    size = np.maximum(np.rint(scale * (upper - lower)), 1).astype(int)
    part = picture[lower[1] : upper[1], lower[0] : upper[0]]
    pixels = cv2.resize(part, size.tolist(), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    enlarged = np.diag([*(size / (upper - lower)), 1.0]) @ K
    enlarged[:2, 2] -= lower * size / (upper - lower)
    places, depth = projected(voxels, viewmat, enlarged)
    inside = np.flatnonzero((depth > 0) & ((places >= 0) & (places < size)).all(axis=1))
    columns, rows = places[inside].astype(int).T
    p = np.clip(saliency(pixels), 0, 1)
    salient = np.log((p + 0.02) / (1.02 - p)).clip(-_MAX_SALIENT, _MAX_SALIENT)
    return _View(number, pixels, enlarged, lower, upper, inside, rows, columns, salient)


def _learn_from_boxes(
    views: Sequence[_View], viewmats: np.ndarray, boxes: Mapping[int, Box], centre: np.ndarray, size: float
) -> None:
    """First evidence of colours: from GrabCut in the boxes, and for the surroundings from each photograph itself."""
    own, around = [], []
    for view in views:
        if view.number in boxes:
            box, scale = boxes[view.number], view.pixels.shape[1] / (view.upper - view.lower)[0]
            y, x = np.indices(view.pixels.shape[:2]) + 0.5
            (x0, y0), (x1, y1) = scale * (box.lower - view.lower), scale * (box.upper - view.lower)
            inside = (x > x0) & (x < x1) & (y > y0) & (y < y1)
            mask = grabcut(view.pixels, inside & (view.salient > 1.5), inside, ~inside)
            own.append(view.pixels[shrunk(mask, 2)])
            around.append(view.pixels[~inside])
            view.colour = np.where(mask, _MAX_COLOUR, -_MAX_COLOUR)
    object_, surroundings = colour_shares(np.concatenate(own)), _shaded_shares(np.concatenate(around))
    for view in views:
        if view.number not in boxes:
            place, depth = projected(centre[None], viewmats[view.number], view.K)
            y, x = np.indices(view.pixels.shape[:2]) + 0.5
            away = np.hypot(x - place[0, 0], y - place[0, 1]) > _AWAY * size * view.K[0, 0] / max(
                depth[0], 1e-9
            )
            nearby = _shaded_shares(view.pixels[away]) if away.sum() > _MIN_AROUND else surroundings
            view.colour = _evidence(view.pixels, object_, (nearby + surroundings) / 2)


def _learn(views: Sequence[_View], silhouettes: Sequence[np.ndarray]) -> None:
    """Evidence of colours from silhouettes.

    A colour of the object that few photographs show is one of something in front of it. The photographs with the
    largest shares of each colour do not count.
    """
    inner, outer = [], []
    for view, silhouette in zip(views, silhouettes):
        band = max(2, round(_CERTAIN * radius_of(silhouette)))
        inner.append(colour_shares(view.pixels[shrunk(silhouette, band)]))
        outer.append(view.pixels[~grown(silhouette, band)])
    counted = max(1, round((1 - _TRIMMED) * len(views)))
    object_ = np.sort(inner, axis=0)[:counted].mean(axis=0)
    object_ /= max(object_.sum(), 1e-9)
    around = _shaded_shares(np.concatenate(outer))
    for view, pixels in zip(views, outer):
        view.colour = _evidence(view.pixels, object_, (_shaded_shares(pixels) + around) / 2)


def _shaded_shares(pixels: np.ndarray) -> np.ndarray:
    """`colour_shares` of surroundings, of which the object's shadow darkens a part that varies between photographs."""
    shaded = [colour_shares(pixels * shade) for shade in _SHADES]
    return (1 - _SHADED) * colour_shares(pixels) + _SHADED * np.mean(shaded, axis=0)


def _evidence(pixels: np.ndarray, object_: np.ndarray, around: np.ndarray) -> np.ndarray:
    ratio = log_ratio(object_, around)[colour_bins(pixels)].clip(-_MAX_COLOUR, _MAX_COLOUR)
    return opencv().GaussianBlur(ratio, (0, 0), 1.0)


def _sight_rays(
    voxels: np.ndarray, voxel: float, viewmats: np.ndarray, points: np.ndarray, seen: np.ndarray
) -> np.ndarray:
    """Number of lines of sight to points through each voxel of the cube, smoothed over neighbours, (V,)."""
    counts = np.zeros((_VOXELS,) * 3)
    views, numbers = np.nonzero(seen)
    eyes = camera_centres(viewmats)[views]
    rays = points[numbers] - eyes
    lengths = np.linalg.norm(rays, axis=1)
    rays = rays / np.maximum(lengths, 1e-12)[:, None]
    lower, middle = voxels[0] - voxel / 2, (voxels[0] + voxels[-1]) / 2
    nearest = ((middle - eyes) * rays).sum(axis=1)
    reach = np.linalg.norm(voxels[-1] - voxels[0]) / 2
    for along in np.arange(-reach, reach, voxel):
        t = nearest + along
        before = (t > 0) & (t < lengths - 2 * voxel)  # a point and its surface are not empty
        cells = np.floor((eyes[before] + t[before, None] * rays[before] - lower) / voxel).astype(int)
        cells = cells[((cells >= 0) & (cells < _VOXELS)).all(axis=1)]
        np.add.at(counts, tuple(cells.T), 1)
    return ndimage.gaussian_filter(counts, 1.0).ravel()


def _body(views: Sequence[_View], allowed: np.ndarray, empty: np.ndarray, name: str) -> np.ndarray:
    """Numbers of the voxels of the object: the connected part with the most evidence."""
    evidence, count = np.zeros((2, len(allowed)))
    for view in views:
        evidence[view.voxels] += view.evidence[view.rows, view.columns].clip(-_AGAINST, _FOR)
        count[view.voxels] += 1
    evidence = evidence / np.maximum(count, 1) - empty
    evidence[count < _MIN_VIEWS * len(views)] = -_FOR
    evidence[~allowed] = -_AGAINST
    smooth = ndimage.gaussian_filter(evidence.reshape((_VOXELS,) * 3), 1.0)
    labels, parts = ndimage.label(smooth > 0)
    if parts == 0:
        raise InputError(
            name,
            "the photographs do not show one object at the place of the box",
            "Draw a tight box around the whole object, boxes in more photographs, or put masks into the folder"
            " masks/photographs",
        )
    sums = ndimage.sum_labels(smooth, labels, np.arange(1, parts + 1))
    return np.flatnonzero(labels.ravel() == 1 + np.argmax(sums))


def _silhouette(view: _View, body: np.ndarray, voxel: float, viewmat: np.ndarray) -> np.ndarray:
    """Silhouette (h, w) of voxels (P, 3) in a view."""
    cv2 = opencv()
    places, depth = projected(body, viewmat, view.K)
    size = view.pixels.shape[1::-1]
    inside = (depth > 0) & ((places >= 0) & (places < size)).all(axis=1)
    drawn = np.zeros(view.pixels.shape[:2], np.uint8)
    columns, rows = places[inside].astype(int).T
    drawn[rows, columns] = 1
    gap = int(np.ceil(0.6 * voxel * view.K[0, 0] / np.median(depth[inside]))) if inside.any() else 0
    return cv2.morphologyEx(drawn, cv2.MORPH_CLOSE, np.ones((2 * gap + 1,) * 2, np.uint8)).view(bool)


def _segment(view: _View, silhouette: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Mask (H, W) of a photograph with the edge near a silhouette, without what stands in front of the object."""
    cv2 = opencv()
    band = max(3.0, _EDGE * radius_of(silhouette))
    inside, outside = (ndimage.distance_transform_edt(each) for each in (silhouette, ~silhouette))
    away = (outside - inside) / band
    cost = -2 * view.evidence + _STIFF * away * np.abs(away)
    cost = np.where(away > 1, UNSEEN, cost)
    cost = np.where(away < -1, np.where(view.colour > _OCCLUDED, -UNSEEN / 2, -2 * view.colour), cost)
    part = component(cheapest(cost, view.pixels.astype(np.float32)))
    mask = np.zeros(shape, bool)
    size = (view.upper - view.lower).tolist()
    large = cv2.resize(part.astype(np.float32), size, interpolation=cv2.INTER_LINEAR) > 0.5
    mask[view.lower[1] : view.upper[1], view.lower[0] : view.upper[0]] = large
    return mask


def _check_filled(mask: np.ndarray, box: Box, where: str) -> None:
    """Raises InputError if a mask does not extend over the width and height of its box."""
    ys, xs = np.nonzero(mask)
    filled = np.array([np.ptp(xs), np.ptp(ys)]) / (2 * box.half) if len(xs) else np.zeros(2)
    if filled.min() < MIN_FILLED:
        raise InputError(
            where,
            f"the selected object fills {filled[0]:.0%} of the width and {filled[1]:.0%} of the height of its box, at"
            f" least {MIN_FILLED:.0%} are required",
            "Draw the box tight around the whole object. If it is, add boxes in other photographs, or put masks into"
            " the folder masks/photographs",
        )
