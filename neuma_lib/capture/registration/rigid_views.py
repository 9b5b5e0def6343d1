"""Pictures of a rigid body in flight, each by one camera at a time of its own, and their residuals.

A camera that sees a moved body sees what a camera that moved the other way would see of the body at rest. So all
pictures are views of the Gaussians as photographed, whose colours turn with the body, in one call of the rasterizer.

Compared are colours over black and coverage. The light of the photographs is in the colours of the Gaussians, and the
body has turned in it. So a factor on each channel of a camera (its gain) and, for each picture, a grey factor that is
linear across the body are fitted along, in closed form; and colours count the less, the less they agree (`weights`).
"""

from __future__ import annotations

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
"""Unknowns that a picture depends on: a turn of the body [rad], a shift [m], both in world axes, its enlargement."""
SHADE_WEIGHT = 0.004
"""A factor of shading that is off by 1 costs as much as a residual of the root of this all over the body."""
_MARGIN = 1.2
"""Side of a crop, in diameters of the body."""
_STEP = 0.3
"""Half width of the differences [px]."""
_DARK, _LEAST_TOLD = 0.04, 20
"""Colour below which a pixel tells no gain, and pixels that do."""
_LIKELY_TINT = 0.15
"""Standard deviation of a camera's tint, as a logarithm."""
_BATCH_BYTES = 48e6


@dataclass(frozen=True, eq=False)
class Sight:
    """What one camera saw of a flight.

    Attributes:
        name: of the camera.
        times: of the frames, by its clock [s], (T,).
        images: straight-alpha RGBA, uint8, (T, H, W, 4).
        viewmat, K: world to camera, OpenCV axes, (4, 4); intrinsics [px], (3, 3).
        offset: what is added to its times to make them those of the first camera [s].
        offset_known: whether that is exact.
    """

    name: str
    times: np.ndarray
    images: np.ndarray
    viewmat: np.ndarray
    K: np.ndarray
    offset: float = 0.0
    offset_known: bool = True

    @property
    def clock(self) -> np.ndarray:
        """Times by the first camera's clock [s], (T,)."""
        return self.times + self.offset

    def select(self, keep: Sequence[int]) -> Sight:
        """The frames with the given indices."""
        keep = list(keep)
        return replace(self, times=self.times[keep], images=self.images[keep])

    def boxes(self) -> np.ndarray:
        """Left, upper, right and lower end of the mask of each frame [px], (T, 4)."""
        found = np.empty((len(self.images), 4))
        for k, image in enumerate(self.images):
            mask = image[..., 3] > 127
            if not mask.any():
                raise InputError(f"{self.name}: a mask of the flight is empty: remove that frame")
            x, y = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
            found[k] = x[0], y[0], x[-1] + 1, y[-1] + 1
        return found


@dataclass(frozen=True, eq=False)
class Body:
    """Gaussians about the centre of mass of their body.

    Attributes:
        gaussians: with means from the centre on [m].
        covars: (G, 3, 3) [m^2].
        sh: (G, K, 3).
        radius: distance of the farthest opaque part from the centre [m].
    """

    gaussians: Gaussians
    covars: Tensor
    sh: Tensor
    radius: float

    @classmethod
    def about(cls, gaussians: Gaussians, centre: np.ndarray) -> Body:
        """Gaussians about a centre (3,) [m]."""
        means = gaussians.means - torch.as_tensor(centre).to(gaussians.means)
        radius = float(torch.quantile(means.norm(dim=1), 0.98))
        moved = replace(gaussians, means=means).to(dtype=torch.float32)
        return cls(moved, moved.covars(), moved.sh(), radius)


class Shown(NamedTuple):
    """A picture and its render, over white, (side, side, 3) in [0, 1].

    Attributes:
        camera: number of the camera.
        time: by its clock [s].
    """

    camera: int
    time: float
    seen: np.ndarray
    rendered: np.ndarray


class Pictures:
    """Crops of N pictures at one resolution, and what a body renders there.

    Attributes:
        camera: number of each picture's camera, (N,).
        times: of each picture by its camera's clock [s], (N,).
        side: of the crops [px].
        spacing: of the world's points that are a pixel apart on the body [m], of each picture, (N,).
        gains: factor on the body's colours of each camera, (cameras, 3).
        weights: of the residuals of colours beside those of coverage, (cameras,).
        covered: pixels of all masks.
    """

    def __init__(self, body: Body, sights: Sequence[Sight], across: float, distances: Sequence[float]):
        """Crops in which the body's diameter takes about ``across`` pixels, or all that there are.

        Args:
            body: what is rendered.
            sights: frames of each camera, one at least.
            distances: depth of the body from each camera [m].
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
            for image, box in zip(sight.images, sight.boxes(), strict=True):
                corner = np.round((box[:2] + box[2:] - self.side * factor) / 2).astype(int)
                crop, inside = _crop(image, corner, self.side, factor)
                K = sight.K.copy()
                K[:2, 2] -= corner
                K[:2] /= factor
                images.append(crop)
                valid.append(inside)
                Ks.append(K)
                blur.append(
                    (1 - factor**-2) / 12
                )  # variance of the average over a square, beyond a pixel's own
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
            picture: number of the picture whose camera and crop each is rendered for, (M,); None: all in turn.
            enlargement: of the body, relative.
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
        found = []
        for k in range(0, len(picture), count):
            image, alpha = rasterize(
                means, covars, g.opacities, self.body.sh, viewmats[k : k + count], Ks[k : k + count],
                self.side, self.side, background=(0.0, 0.0, 0.0), eps2d=self._eps2d,
            )  # fmt: skip
            found.append(torch.cat([image[0], alpha[0, ..., None]], dim=-1))
        return torch.cat(found)

    def moments(
        self, images: Tensor | None = None, picture: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Centroid (M, 2) [px of the crop] and area (M,) [px] of the coverage of renders, or of what was seen."""
        alpha = (self._observed if images is None else images)[..., 3]
        alpha = alpha * (self._valid if picture is None else self._valid[picture])[..., 0]
        area = alpha.sum(dim=(1, 2)).double()
        at = torch.arange(self.side) + 0.5
        x, y = (alpha.sum(dim=1) @ at / area, alpha.sum(dim=2) @ at / area)
        return torch.stack([x, y], dim=1).numpy(), area.numpy()

    def shifts(
        self, off: np.ndarray, area: np.ndarray, centres: np.ndarray, picture: np.ndarray
    ) -> np.ndarray:
        """Shifts (B, 3) [m] of a body that take centroids by ``off`` (B, P, 2) [px]; of least size in a single view.

        Args:
            area: ratio of the seen area to the rendered one, (B, P): tells the distance of one camera alone.
            centres: where the body is in each picture, (P, 3).
            picture: numbers of the P pictures.
        """
        views, Ks = self._views[self.camera[picture]], self._Ks[picture].numpy()
        depth = np.einsum("pj,pj->p", views[:, 2, :3], centres) + views[:, 2, 3]
        A = (Ks[:, [0, 1], [0, 1]] / depth[:, None])[..., None] * views[:, :2, :3]  # (P, 2, 3)
        found = off.reshape(len(off), -1) @ np.linalg.pinv(A.reshape(-1, 3), rcond=1e-2).T
        if len(set(self.camera[picture])) == 1:
            eye = -views[0, :3, :3].T @ views[0, :3, 3]
            farther = np.clip(np.median(area, axis=1) ** -0.5, 0.5, 2.0) - 1
            found += farther[:, None] * (centres.mean(axis=0) - eye)
        return found

    def fit_gains(self, renders: Tensor, grey: bool = False) -> None:
        """Set the gains to medians of seen over rendered, where both show the body.

        What the light changes differs from place to place and is alike in all channels: so the channels of a pixel tell
        the tint, and all pixels the brightness. Where pixels disagree on the tint, as they do on a side that was not
        photographed, it is taken to be smaller.

        Args:
            renders: of all pictures in turn, any number of times.
            grey: whether the tint is left at 1, because renders show other parts of the body.
        """
        picture = np.arange(len(renders)) % len(self)
        for camera in range(self.cameras):
            of = self.camera[picture] == camera
            seen, rendered = self._observed[picture[of]], renders[of]
            both = torch.minimum(seen, rendered)
            told = (both[..., 3] > 0.5) & (both[..., :3].amin(dim=-1) > _DARK)
            if int(told.sum()) >= _LEAST_TOLD:
                ratio = (seen[..., :3][told] / rendered[..., :3][told]).log()
                brightness = ratio.mean(dim=1, keepdim=True)
                tints = ratio - brightness
                tint = tints.median(dim=0).values
                spread = (tints - tint).abs().median() / 2
                tint = 0 * tint if grey else (tint - tint.mean()) / (1 + (spread / _LIKELY_TINT) ** 2)
                self.gains[camera] = (tint + brightness.median()).exp().double().numpy()

    def residual_ratio(self, renders: Tensor) -> np.ndarray:
        """Root mean square residuals of coverage over those of colours, of each camera, (cameras,).

        Where light makes colours differ, they say less than outlines about the pose, by that ratio.
        """
        self.weights = np.ones(self.cameras)
        squares = self.residuals(renders)[0].square().sum(dim=(1, 2)).double().numpy()
        sums = np.stack([squares[self.camera == k].sum(axis=0) for k in range(self.cameras)])
        return np.sqrt(sums[:, 3] / np.maximum(sums[:, :3].mean(axis=1), 1e-12))

    def residuals(self, renders: Tensor, picture: np.ndarray | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Rendered minus seen (M, side, side, 4), with the best shading; its cost (M,); shading columns (M, P, 3)."""
        picture = np.arange(len(self)) if picture is None else picture
        valid = self._valid[picture]
        lit = self._lit(renders, picture) * valid
        r = lit - self._weighted(self._observed[picture], picture) * valid
        shade = _columns(lit[..., :3, None] * self._ramps[:, :, None])  # of the colours; coverage has none
        flat = r[..., :3].reshape(len(r), -1)
        a = -torch.linalg.solve(self._shade_normal(shade, picture), shade.mT @ flat[..., None])
        r = torch.cat([(flat + (shade @ a)[..., 0]).reshape(r[..., :3].shape), r[..., 3:]], dim=-1)
        cost = r.square().sum(dim=(1, 2, 3)) + self._shade_cost(picture) * a[..., 0].square().sum(dim=1)
        return r, cost.double(), shade

    def normal_equations(
        self, rotations: np.ndarray, centres: np.ndarray, enlargement: float, central: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Problem of each picture by its own unknowns (`LOCAL`), in the blocks of `in_blocks`, the shading eliminated.

        Args:
            rotations, centres: poses of the body in the pictures, (N, 3, 3) and (N, 3).
            enlargement: of the body.
            central: whether differences are central ones, at twice the cost of forward ones.

        Returns:
            Curvatures (N, blocks, 7, 7) and scores (N, blocks, 7), whose sums over the blocks are J^T J and J^T r, and
            costs (N,).
        """
        size = max(1, int(_BATCH_BYTES / (4 * 4 * 4 * LOCAL * self.side**2)))
        found = [
            self._normal_equations(
                np.arange(len(self))[part], rotations[part], centres[part], enlargement, central
            )
            for part in frame_batches(len(self), size)
        ]
        return tuple(np.concatenate(parts) for parts in zip(*found, strict=True))

    def _normal_equations(self, picture, rotations, centres, enlargement, central):
        here = self.render(rotations, centres, picture, enlargement)
        r, cost, shade = self.residuals(here, picture)
        step = _STEP * self.spacing[picture]
        widths = np.stack(
            [step / self.body.radius] * 3 + [step] * 3 + [np.full_like(step, step.mean() / self.body.radius)]
        )
        sides = (1.0, -1.0) if central else (1.0,)
        turns, shifts = [], []
        for k, side in itertools.product(range(LOCAL - 1), sides):
            by = side * widths[k][:, None] * np.eye(3)[k % 3]
            turns.append(Rotation.from_rotvec(by).as_matrix() @ rotations if k < 3 else rotations)
            shifts.append(centres + by if k >= 3 else centres)
        posed = self.render(
            np.concatenate(turns), np.concatenate(shifts), np.tile(picture, len(turns)), enlargement
        ).unflatten(0, (LOCAL - 1, len(sides), len(picture)))
        grown = torch.stack([
            self.render(rotations, centres, picture, enlargement + side * widths[-1, 0]) for side in sides
        ])  # fmt: skip
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

    def agreement(self, renders: Tensor, costs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """IoU of outlines and masks, distance of their centroids in pixels of the video, and root mean square residual
        over the mask, (N,) each, of renders of all pictures and their costs."""
        valid = self._valid[..., 0] > 0
        a, b = ((image[..., 3] > 0.5) & valid for image in (renders, self._observed))
        iou = (a & b).sum(dim=(1, 2)) / (a | b).sum(dim=(1, 2)).clamp_min(1)
        off = np.linalg.norm(self.moments(renders)[0] - self.moments()[0], axis=1)
        off = np.where(np.isfinite(off), off, self.side) * self._factor
        return iou.numpy(), off, np.sqrt(costs / self._mask_size.numpy())

    def shown(self, renders: Tensor, most: int) -> list[Shown]:
        """At most ``most`` pictures of each camera beside renders of all pictures, in the camera's gain."""
        found = []
        for camera in range(self.cameras):
            of = np.flatnonzero(self.camera == camera)
            for k in of[spread_frames(len(of), most)]:
                seen, rendered = (
                    np.clip((image[..., :3] + 1 - image[..., 3:]).numpy(), 0, 1)
                    for image in (
                        self._observed[k],
                        self._scaled(renders[k : k + 1], self.gains[[camera]])[0],
                    )
                )
                found.append(Shown(camera, float(self.times[k]), seen, rendered))
        return found

    def _shade_cost(self, picture: np.ndarray) -> Tensor:
        weights = torch.tensor(self.weights[self.camera[picture]]).float()
        return SHADE_WEIGHT * weights**2 * self._mask_size[picture]

    def _weighted(self, images: Tensor, picture: np.ndarray) -> Tensor:
        return self._scaled(images, np.repeat(self.weights[:, None], 3, axis=1)[self.camera[picture]])

    def _lit(self, renders: Tensor, picture: np.ndarray) -> Tensor:
        return self._scaled(renders, (self.gains * self.weights[:, None])[self.camera[picture]])

    @staticmethod
    def _scaled(images: Tensor, factors: np.ndarray) -> Tensor:
        """Images (M, side, side, 4) with their colours times factors (M, 3)."""
        factors = torch.tensor(factors).float()
        return images * torch.cat([factors, torch.ones(len(factors), 1)], dim=1)[:, None, None]


def _columns(values: Tensor) -> Tensor:
    """(M, H, W, C, K) as (M, H W C, K)."""
    return values.reshape(len(values), -1, values.shape[-1])


def _crop(image: np.ndarray, corner: np.ndarray, side: int, factor: int) -> tuple[Tensor, Tensor]:
    """Colours over black and coverage (side, side, 4) of a square of straight-alpha RGBA (H, W, 4), uint8, averaged
    over ``factor`` pixels each way; and where all of these lie in the picture (side, side)."""
    height, width = image.shape[:2]
    whole = np.zeros((side * factor, side * factor, 5), np.float32)
    (x0, y0), (x1, y1) = np.maximum(corner, 0), np.minimum(corner + side * factor, (width, height))
    if x1 > x0 and y1 > y0:
        part = image[y0:y1, x0:x1].astype(np.float32) / 255
        part[..., :3] *= part[..., 3:]
        to = np.s_[y0 - corner[1] : y1 - corner[1], x0 - corner[0] : x1 - corner[0]]
        whole[to][..., :4], whole[to][..., 4] = part, 1
    small = whole.reshape(side, factor, side, factor, 5).mean(axis=(1, 3))
    return torch.from_numpy(small[..., :4].copy()), torch.from_numpy(
        (small[..., 4] > 0.999).astype(np.float32)
    )
