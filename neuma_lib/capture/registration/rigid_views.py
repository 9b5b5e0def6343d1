"""Pictures of a rigid body in flight by several cameras at different times, and their residuals.

A moving body in front of a fixed camera is equivalent to a fixed body in front of a moving camera. All pictures are
therefore views of the photographed Gaussians, whose colours rotate with the body, in one call of the rasterizer.

Colours over black and coverage are compared. The colours of the Gaussians include the illumination of the photographs,
in which the body has rotated. A gain per channel of a camera, and a grey factor per picture that is linear over the
body, are therefore fitted in closed form, and colours that agree poorly have lower weights (`weights`).
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from neuma_lib.errors import InputError
from neuma_lib.fitting.frame_batches import frame_batches, spread_frames
from neuma_lib.fitting.least_squares import in_blocks
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.rasterizer import rasterize

LOCAL = 7
"""Unknowns of a picture: rotation of the body [rad] and shift [m], both in world axes, and enlargement."""
SHADE_WEIGHT = 0.004
"""Squared residual over the body that is equivalent to a change of the shading factor by 1."""
_MARGIN = 1.2  # side of a crop, in diameters of the body
_STEP = 0.3  # half width of the differences [px]
_MIN_COLOUR, _MIN_PIXELS = 0.04, 20  # minimum colour of pixels for the gain, and their minimum number
_LIKELY_TINT = 0.15  # prior standard deviation of the logarithm of the tint of a camera
_BATCH_BYTES = 48e6


@dataclass(frozen=True, eq=False)
class Sight:
    """Frames of a flight by one camera."""

    name: str  # name of the camera
    times: np.ndarray  # times of the frames by its clock [s], (T,)
    images: np.ndarray  # straight-alpha RGBA, uint8, (T, H, W, 4)
    # viewmat, K: world to camera, OpenCV axes, (4, 4); intrinsics [px], (3, 3)
    viewmat: np.ndarray
    K: np.ndarray
    offset: float = 0.0  # offset of its times to the clock of the first camera [s]
    offset_known: bool = True  # whether the offset is exact
    hidden: np.ndarray | None = None  # pixels that show another body, (T, H, W), None without others

    @property
    def clock(self) -> np.ndarray:
        """Times by the clock of the first camera [s], (T,)."""
        return self.times + self.offset

    def select(self, keep: Sequence[int]) -> "Sight":
        """The frames with the given indices."""
        keep = list(keep)
        hidden = None if self.hidden is None else self.hidden[keep]
        return replace(self, times=self.times[keep], images=self.images[keep], hidden=hidden)

    def boxes(self) -> np.ndarray:
        """Left, upper, right and lower bound of the mask of each frame [px], (T, 4)."""
        boxes = np.empty((len(self.images), 4))
        for k, image in enumerate(self.images):
            mask = image[..., 3] > 127
            if not mask.any():
                raise InputError(self.name, f"the mask of flight frame {k} is empty", "Remove that frame")
            x, y = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
            boxes[k] = x[0], y[0], x[-1] + 1, y[-1] + 1
        return boxes


@dataclass(frozen=True, eq=False)
class Body:
    """Gaussians relative to the centre of mass of their body."""

    gaussians: Gaussians  # with means relative to the centre [m]
    covars: Tensor  # (G, 3, 3) [m^2]
    sh: Tensor  # colours, (G, K, 3)
    radius: float  # 98th percentile of the distances of means from the centre [m]

    @classmethod
    def about(cls, gaussians: Gaussians, centre: np.ndarray) -> "Body":
        """Gaussians relative to a centre (3,) [m]."""
        means = gaussians.means - torch.as_tensor(centre).to(gaussians.means)
        radius = float(torch.quantile(means.norm(dim=1), 0.98))
        moved = replace(gaussians, means=means).to(dtype=torch.float32)
        return cls(moved, moved.covars(), moved.sh(), radius)


@dataclass(frozen=True, eq=False)
class Agreement:
    """Agreement of a pose with the images, each of shape (pictures,)."""

    camera: np.ndarray  # index of the camera
    iou: np.ndarray  # IoU of mask and rendered silhouette
    off: np.ndarray  # distance of their centroids [px of the video]
    rms: np.ndarray  # root mean square residual of colours and coverage over the mask

    def by_camera(self, names: Sequence[str]) -> dict[str, dict[str, float]]:
        """JSON values by name of the camera."""
        values = {}
        for k, name in enumerate(names):
            iou, off, rms = (value[self.camera == k] for value in (self.iou, self.off, self.rms))
            rms = np.sqrt(np.square(rms).mean())
            statistics = {"iou": iou.mean(), "least_iou": iou.min(), "centroid_px": off.mean(), "rms": rms}
            values[name] = {key: float(value) for key, value in statistics.items()}
        return values


class Comparison(NamedTuple):
    """A picture and its render, over white, (side, side, 3) in [0, 1]; index and time [s] of its camera."""

    camera: int
    time: float
    seen: np.ndarray
    rendered: np.ndarray


class Pictures:
    """Crops of N pictures with the same size, and renders of a body in these crops.

    Attributes:
        camera: index of the camera of each picture, (N,).
        times: time of each picture by the clock of its camera [s], (N,).
        side: side of the crops [px].
        spacing: size of a pixel on the body in each picture [m], (N,).
        gains: factors on the colours of the body for each camera, (cameras, 3).
        weights: weights of the residuals of colours relative to coverage, (cameras,).
        covered: number of pixels of all masks.
    """

    def __init__(self, body: Body, sights: Sequence[Sight], across: float, distances: Sequence[float]):
        """Crops in which the diameter of the body is about ``across`` pixels, or its size in the video if that is less.

        Args:
            body: the body to render.
            sights: frames of each camera, at least one.
            distances: depth of the body in each camera [m].
        """
        self.body, self.cameras = body, len(sights)
        sizes, factors = [], []
        for sight, distance in zip(sights, distances, strict=True):
            boxes = sight.boxes()
            seen = max((boxes[:, 2:] - boxes[:, :2]).max(), 2 * body.radius * sight.K[0, 0] / distance)
            factors.append(max(1, int(seen / across)))
            sizes.append(_MARGIN * seen / factors[-1])
        self.side = int(np.ceil(max(sizes)))
        self.camera = np.repeat(np.arange(len(sights)), [len(sight.images) for sight in sights])
        self.times = np.concatenate([sight.times for sight in sights])
        self.gains, self.weights = np.ones((self.cameras, 3)), np.ones(self.cameras)
        images, valid, Ks, blur, spacing = [], [], [], [], []
        for sight, factor, distance in zip(sights, factors, distances, strict=True):
            unknown = np.zeros(len(sight.images), bool) if sight.hidden is None else sight.hidden
            for image, box, hidden in zip(sight.images, sight.boxes(), unknown, strict=True):
                corner = np.round((box[:2] + box[2:] - self.side * factor) / 2).astype(int)
                crop, inside = _crop(image, corner, self.side, factor, hidden)
                K = sight.K.copy()
                K[:2, 2] -= corner
                K[:2] /= factor
                images.append(crop)
                valid.append(inside)
                Ks.append(K)
                # Variance of the average over a square minus that of a pixel.
                blur.append((1 - factor**-2) / 12)
                spacing.append(distance / K[0, 0])
        self._observed, self._valid = torch.stack(images), torch.stack(valid)[..., None]
        self._Ks, self._views = torch.tensor(np.stack(Ks)).float(), np.stack([s.viewmat for s in sights])
        self._eps2d, self.spacing = float(np.mean(blur)), np.array(spacing)
        y, x = torch.meshgrid(*[torch.linspace(-1, 1, self.side)] * 2, indexing="ij")
        self._ramps = torch.stack([torch.ones_like(x), x, y], dim=-1)
        self._mask_size = self._observed[..., 3].sum(dim=(1, 2))
        self.covered = float(self._mask_size.sum())
        self._factor = np.array(factors)[self.camera]

    def __len__(self) -> int:
        return len(self.camera)

    def render(
        self,
        rotations: np.ndarray,
        centres: np.ndarray,
        picture: np.ndarray | None = None,
        enlargement: float = 0.0,
    ) -> Tensor:
        """Colours over black and coverage (M, side, side, 4) of the body at rotations (M, 3, 3) and centres (M, 3) [m].

        Args:
            picture: indices (M,) of the pictures whose cameras and crops are used, by default all in order.
            enlargement: relative enlargement of the body.
        """
        picture = np.arange(len(self)) if picture is None else picture
        views = self._views[self.camera[picture]]
        moved = np.tile(np.eye(4), (len(picture), 1, 1))
        moved[:, :3, :3] = views[:, :3, :3] @ rotations
        moved[:, :3, 3] = np.einsum("nij,nj->ni", views[:, :3, :3], centres) + views[:, :3, 3]
        viewmats, Ks = torch.tensor(moved).float(), self._Ks[picture]
        g, size = self.body.gaussians, 1 + enlargement
        means, covars = size * g.means[None], size**2 * self.body.covars[None]
        per_view = 4 * (12 * len(g) + 14 * self.side**2)
        count = max(1, int(_BATCH_BYTES / per_view))
        images = []
        for k in range(0, len(picture), count):
            image, alpha = rasterize(
                means, covars, g.opacities, self.body.sh, viewmats[k : k + count], Ks[k : k + count],
                self.side, self.side, background=(0.0, 0.0, 0.0), eps2d=self._eps2d,
            )  # fmt: skip
            images.append(torch.cat([image[0], alpha[0, ..., None]], dim=-1))
        return torch.cat(images)

    def moments(
        self, images: Tensor | None = None, picture: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Centroids (M, 2) [px of the crop] and areas (M,) [px] of the coverage of renders or observed pictures."""
        alpha = (self._observed if images is None else images)[..., 3]
        alpha = alpha * (self._valid if picture is None else self._valid[picture])[..., 0]
        area = alpha.sum(dim=(1, 2)).double()
        at = torch.arange(self.side) + 0.5
        x, y = (alpha.sum(dim=1) @ at / area, alpha.sum(dim=2) @ at / area)
        return torch.stack([x, y], dim=1).numpy(), area.numpy()

    def shifts(
        self, off: np.ndarray, area: np.ndarray, centres: np.ndarray, picture: np.ndarray
    ) -> np.ndarray:
        """Minimum-norm shifts (B, 3) [m] of a body that shift its centroids by ``off`` (B, P, 2) [px].

        Args:
            area: ratios (B, P) of observed to rendered area, which determine the distance for a single camera.
            centres: positions of the body in each picture, (P, 3).
            picture: indices of the P pictures.
        """
        views, Ks = self._views[self.camera[picture]], self._Ks[picture].numpy()
        depth = np.einsum("pj,pj->p", views[:, 2, :3], centres) + views[:, 2, 3]
        A = (Ks[:, [0, 1], [0, 1]] / depth[:, None])[..., None] * views[:, :2, :3]  # (P, 2, 3)
        shifts = off.reshape(len(off), -1) @ np.linalg.pinv(A.reshape(-1, 3), rcond=1e-2).T
        if len(set(self.camera[picture])) == 1:
            eye = -views[0, :3, :3].T @ views[0, :3, 3]
            farther = np.clip(np.median(area, axis=1) ** -0.5, 0.5, 2.0) - 1
            shifts += farther[:, None] * (centres.mean(axis=0) - eye)
        return shifts

    def fit_gains(self, renders: Tensor, grey: bool = False) -> None:
        """Set the gains to medians of the ratio of observed to rendered colours, where both show the body.

        Illumination changes differ between positions and are equal in all channels. The tint is therefore estimated
        from the ratios of the channels of each pixel, and the brightness from all pixels. The tint is shrunk if pixels
        disagree, as for a side without photographs.

        Args:
            renders: renders of all pictures in order, any number of times.
            grey: whether to keep a tint of 1, because renders show other parts of the body.
        """
        picture = np.arange(len(renders)) % len(self)
        for camera in range(self.cameras):
            of = self.camera[picture] == camera
            observed, rendered = self._observed[picture[of]], renders[of]
            both = torch.minimum(observed, rendered)
            valid = (both[..., 3] > 0.5) & (both[..., :3].amin(dim=-1) > _MIN_COLOUR)
            if int(valid.sum()) >= _MIN_PIXELS:
                ratio = (observed[..., :3][valid] / rendered[..., :3][valid]).log()
                brightness = ratio.mean(dim=1, keepdim=True)
                tints = ratio - brightness
                tint = tints.median(dim=0).values
                spread = (tints - tint).abs().median() / 2
                tint = 0 * tint if grey else (tint - tint.mean()) / (1 + (spread / _LIKELY_TINT) ** 2)
                self.gains[camera] = (tint + brightness.median()).exp().double().numpy()

    def residual_ratio(self, renders: Tensor) -> np.ndarray:
        """Ratio (cameras,) of the root mean square residuals of coverage to those of colours for each camera.

        It weights colours, which are less reliable than silhouettes if the illumination differs.
        """
        self.weights = np.ones(self.cameras)
        squares = self.residuals(renders)[0].square().sum(dim=(1, 2)).double().numpy()
        sums = np.stack([squares[self.camera == k].sum(axis=0) for k in range(self.cameras)])
        return np.sqrt(sums[:, 3] / np.maximum(sums[:, :3].mean(axis=1), 1e-12))

    def residuals(self, renders: Tensor, picture: np.ndarray | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Rendered minus observed (M, side, side, 4) with optimal shading, costs (M,), shading columns (M, P, 3)."""
        picture = np.arange(len(self)) if picture is None else picture
        valid = self._valid[picture]
        lit = self._lit(renders, picture) * valid
        r = lit - self._weighted(self._observed[picture], picture) * valid
        shade = (lit[..., :3, None] * self._ramps[:, :, None]).flatten(1, 3)  # (M, P, 3), colours only
        flat = r[..., :3].reshape(len(r), -1)
        a = -torch.linalg.solve(self._shade_normal(shade, picture), shade.mT @ flat[..., None])
        r = torch.cat([(flat + (shade @ a)[..., 0]).reshape(r[..., :3].shape), r[..., 3:]], dim=-1)
        cost = r.square().sum(dim=(1, 2, 3)) + self._shade_cost(picture) * a[..., 0].square().sum(dim=1)
        return r, cost.double(), shade

    def normal_equations(
        self, rotations: np.ndarray, centres: np.ndarray, enlargement: float, central: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Linearised problem of each picture in its own unknowns (`LOCAL`) by blocks, with the shading eliminated.

        Args:
            rotations, centres: of the body in the pictures, (N, 3, 3) and (N, 3).
            enlargement: of the body, relative.
            central: whether to use central differences, at twice the cost of forward ones.

        Returns:
            Curvatures (N, blocks, 7, 7) and scores (N, blocks, 7), whose sums over blocks are J^T J and J^T r, and
            costs (N,).
        """
        size = max(1, int(_BATCH_BYTES / (4 * 4 * 4 * LOCAL * self.side**2)))
        every = np.arange(len(self))
        batches = [
            self._normal_equations(every[part], rotations[part], centres[part], enlargement, central)
            for part in frame_batches(len(self), size)
        ]
        return tuple(np.concatenate(parts) for parts in zip(*batches, strict=True))

    def _normal_equations(self, picture, rotations, centres, enlargement, central):
        here = self.render(rotations, centres, picture, enlargement)
        r, cost, shade = self.residuals(here, picture)
        step, radius = _STEP * self.spacing[picture], self.body.radius
        widths = np.stack([step / radius] * 3 + [step] * 3 + [np.full_like(step, step.mean() / radius)])
        sides = (1.0, -1.0) if central else (1.0,)
        turns, shifts = [], []
        for k, side in itertools.product(range(LOCAL - 1), sides):
            by = side * widths[k][:, None] * np.eye(3)[k % 3]
            turns.append(Rotation.from_rotvec(by).as_matrix() @ rotations if k < 3 else rotations)
            shifts.append(centres + by if k >= 3 else centres)
        poses = np.concatenate(turns), np.concatenate(shifts)
        posed = self.render(*poses, np.tile(picture, len(turns)), enlargement)
        posed = posed.unflatten(0, (LOCAL - 1, len(sides), len(picture)))
        larger = (enlargement + side * widths[-1, 0] for side in sides)
        grown = torch.stack([self.render(rotations, centres, picture, size) for size in larger])
        moved = torch.cat([posed, grown[None]])  # (7, sides, M, side, side, 4)
        change = (moved[:, 0] - moved[:, 1]) / 2 if central else moved[:, 0] - here
        change = change / torch.tensor(widths).float()[..., None, None, None]
        columns = [self._lit(each, picture) for each in change]
        J = torch.stack(columns, dim=-1) * self._valid[picture][..., None]  # (M, side, side, 4, 7)
        colours = J[..., :3, :].reshape(len(J), -1, LOCAL)
        taken = torch.linalg.solve(self._shade_normal(shade, picture), shade.mT @ colours)
        left = J.clone()
        left[..., :3, :] -= (shade @ taken).reshape(J[..., :3, :].shape)
        blocks, left = (in_blocks(value.flatten(3)[None]) for value in (J, left))
        blocks, left = (each.reshape(len(J), -1, each.shape[1] // LOCAL, LOCAL) for each in (blocks, left))
        off = in_blocks(r[None]).reshape(*blocks.shape[:3], 1)
        curvature = (blocks.mT @ left).double()
        curvature = (curvature + curvature.mT) / 2
        return curvature.numpy(), (blocks.mT @ off)[..., 0].double().numpy(), cost.numpy()

    def _shade_normal(self, shade: Tensor, picture: np.ndarray) -> Tensor:
        return shade.mT @ shade + torch.diag_embed(self._shade_cost(picture)[:, None].expand(-1, 3))

    def agreement(self, renders: Tensor, costs: np.ndarray) -> Agreement:
        """Agreement of all pictures with their renders, from these and their costs (N,)."""
        valid = self._valid[..., 0] > 0
        a, b = ((image[..., 3] > 0.5) & valid for image in (renders, self._observed))
        iou = (a & b).sum(dim=(1, 2)) / (a | b).sum(dim=(1, 2)).clamp_min(1)
        off = np.linalg.norm(self.moments(renders)[0] - self.moments()[0], axis=1)
        off = np.where(np.isfinite(off), off, self.side) * self._factor
        return Agreement(self.camera, iou.numpy(), off, np.sqrt(costs / self._mask_size.numpy()))

    def comparisons(self, renders: Tensor, limit: int) -> list[Comparison]:
        """At most ``limit`` pictures of each camera with their renders, multiplied by the gain of the camera."""
        comparisons = []
        for camera in range(self.cameras):
            of = np.flatnonzero(self.camera == camera)
            for k in of[spread_frames(len(of), limit)]:
                pair = self._observed[k], self._scaled(renders[k : k + 1], self.gains[[camera]])[0]
                over_white = (np.clip((x[..., :3] + 1 - x[..., 3:]).numpy(), 0, 1) for x in pair)
                comparisons.append(Comparison(camera, float(self.times[k]), *over_white))
        return comparisons

    def _shade_cost(self, picture: np.ndarray) -> Tensor:
        weights = torch.tensor(self.weights[self.camera[picture]]).float()
        return SHADE_WEIGHT * weights**2 * self._mask_size[picture]

    def _weighted(self, images: Tensor, picture: np.ndarray) -> Tensor:
        return self._scaled(images, np.repeat(self.weights[:, None], 3, axis=1)[self.camera[picture]])

    def _lit(self, renders: Tensor, picture: np.ndarray) -> Tensor:
        return self._scaled(renders, (self.gains * self.weights[:, None])[self.camera[picture]])

    @staticmethod
    def _scaled(images: Tensor, factors: np.ndarray) -> Tensor:
        """Images (M, side, side, 4) with colours multiplied by factors (M, 3)."""
        factors = torch.tensor(factors).float()
        return images * torch.cat([factors, torch.ones(len(factors), 1)], dim=1)[:, None, None]


def _crop(
    image: np.ndarray, corner: np.ndarray, side: int, factor: int, hidden: np.ndarray
) -> tuple[Tensor, Tensor]:
    """Colours over black and coverage (side, side, 4) of a square crop of straight-alpha RGBA (H, W, 4), uint8,
    averaged over squares of ``factor`` pixels, and a mask (side, side) of squares within the image that show no other
    body. ``hidden`` are the pixels that do, (H, W) or ()."""
    height, width = image.shape[:2]
    whole = np.zeros((side * factor, side * factor, 5), np.float32)
    (x0, y0), (x1, y1) = np.maximum(corner, 0), np.minimum(corner + side * factor, (width, height))
    if x1 > x0 and y1 > y0:
        part = image[y0:y1, x0:x1].astype(np.float32) / 255
        part[..., :3] *= part[..., 3:]
        to = np.s_[y0 - corner[1] : y1 - corner[1], x0 - corner[0] : x1 - corner[0]]
        whole[to][..., :4], whole[to][..., 4] = part, ~(hidden[y0:y1, x0:x1] if hidden.ndim else hidden)
    small = whole.reshape(side, factor, side, factor, 5).mean(axis=(1, 3))
    inside = (small[..., 4] > 0.999).astype(np.float32)
    return torch.from_numpy(small[..., :4].copy()), torch.from_numpy(inside)
