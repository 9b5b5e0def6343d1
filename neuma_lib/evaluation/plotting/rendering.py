"""Pictures for figures: video frames, magnified renders, particles, and crops."""

from collections.abc import Sequence

import numpy as np
import torch
from matplotlib.colors import to_rgb
from torch import Tensor

from neuma_lib.coupling.deformation import arms_at_rest, deform
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.evaluation.plotting.spheres import draw_spheres
from neuma_lib.io.images import load_observation
from neuma_lib.io.particles import load_reconstruction
from neuma_lib.mechanics.density import Density
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.extent import outermost
from neuma_lib.splatting.observation import Observation
from neuma_lib.splatting.viewpoints import video_views

DENSITY = 1000.0  # density of bodies whose pictures do not depend on it [kg/m^3]
_WHITE = 250  # minimum value of a background colour
_FLATTEST, _TALLEST = 0.6, 1.5  # limits of a picture's height relative to its width
_BATCH = 4  # number of frames rendered at a time
_UNIT_BALL_RADIUS = 0.62  # radius of the ball of volume 1: (3 / (4 pi))^(1/3)


def magnified(cameras: Cameras, factor: int) -> Cameras:
    """The same cameras with ``factor`` times as many pixels along each axis."""
    scale = torch.tensor([factor, factor, 1.0], dtype=cameras.Ks.dtype, device=cameras.Ks.device)
    return Cameras(
        cameras.viewmats, cameras.Ks * scale[:, None], cameras.width * factor, cameras.height * factor
    )


def film(inputs, params, k: int, density: Density) -> tuple[Observation, Reconstruction, Cameras]:
    """Scene ``k`` of a figure: video in one view, body, and camera at the magnification of the figure."""
    video = load_observation(inputs.transforms[k], [params.view])
    body = load_reconstruction(inputs.particles[k], inputs.binding[k], inputs.gaussians[k], density)
    return video, body, magnified(video.cameras, params.magnify)


def bodies(inputs, **options) -> list[Reconstruction]:
    """All bodies of a figure, for pictures only."""
    files = zip(inputs.particles, inputs.binding, inputs.gaussians, strict=True)
    return [load_reconstruction(*of_body, DENSITY, **options) for of_body in files]


def picture_size(wide: float, high: float, width: int) -> tuple[int, int]:
    """Width and height [px] of a picture of a body that is ``wide`` and ``high``."""
    return width, round(width * float(np.clip(high / wide, _FLATTEST, _TALLEST)))


def frontal(points: np.ndarray, width: int, height: int) -> Cameras:
    """A horizontal camera that sees points (..., 3) [m], like view 0 of the videos."""
    views = video_views(points.reshape(-1, 3), 1, width, height)
    return Cameras(
        torch.from_numpy(views.viewmats).float(), torch.from_numpy(views.K[None]).float(), width, height
    )


def seen_around(body: Reconstruction, x: Tensor, F: Tensor) -> np.ndarray:
    """Points (n, 3) [m] around the visible Gaussians of a body in states x (T, N, 3) [m] and F (T, N, 3, 3)."""
    g, covars = body.gaussians, body.gaussians.covars()
    arms = arms_at_rest(g.means, body.binding, body.x0) if body.affine else None
    points = []
    with torch.no_grad():
        for k in range(len(x)):
            state = x[k : k + 1].to(body.x0), F[k : k + 1].to(body.x0)
            means, moved = deform(g.means, covars, body.binding, body.x0, *state, arms=arms)
            points.append(outermost(means[0], moved[0], g.opacities))
    return torch.cat(points).cpu().numpy()


def as_bytes(images: Tensor) -> np.ndarray:
    """Colours in [0, 1] as uint8."""
    return (255 * images.detach().cpu().numpy().clip(0, 1)).round().astype(np.uint8)


def renders(body: Reconstruction, cameras: Cameras, x: Tensor, F: Tensor) -> np.ndarray:
    """Pictures of states x (T, N, 3) [m] and F (T, N, 3, 3) in the first view: uint8 (T, H, W, 3).

    ``body`` is a reconstruction or another object with ``particle_gs``.
    """
    with torch.no_grad():
        parts = [images[:, 0] for _, images in body.particle_gs(cameras[0]).batches(x, F, size=_BATCH)]
    return as_bytes(torch.cat(parts))


def observed(observation: Observation, index: Sequence[int], factor: int) -> np.ndarray:
    """Frames of the video with each pixel repeated: uint8 (T, H factor, W factor, 3)."""
    images = as_bytes(observation.colours(list(index))[:, 0])
    return images.repeat(factor, axis=1).repeat(factor, axis=2)


def particle_pictures(
    x: np.ndarray | Tensor, color: str | np.ndarray, radius: float, cameras: Cameras
) -> np.ndarray:
    """Particles x (T, N, 3) [m] as spheres in the first view: uint8 (T, H, W, 3).

    Args:
        color: a colour of matplotlib, or colours (N, 3) in [0, 1].
        radius: of the spheres [m].
    """
    colors = np.asarray(to_rgb(color) if isinstance(color, str) else color)
    viewmat, K = (matrices[0].double().cpu().numpy() for matrices in (cameras.viewmats, cameras.Ks))
    camera = viewmat, K, cameras.width, cameras.height
    return np.stack([draw_spheres(np.asarray(frame, np.float64), colors, radius, *camera) for frame in x])


def sphere_radius(vol0: np.ndarray | Tensor) -> float:
    """Radius [m] of a sphere of the mean of particle volumes ``vol0`` (N,) [m^3]."""
    return _UNIT_BALL_RADIUS * float(np.asarray(vol0).mean()) ** (1 / 3)


def evenly(count: int, total: int) -> list[int]:
    """Indices of ``count`` evenly spaced frames out of ``total``, including the first and the last."""
    return sorted(set(np.linspace(0, total - 1, min(count, total)).round().astype(int).tolist()))


def milliseconds(steps: Sequence[int], dt: float) -> list[str]:
    """Times of simulation steps as titles of pictures."""
    return [f"{1e3 * dt * step:.0f} ms" for step in steps]


def cropped(
    groups: Sequence[np.ndarray], margin: float = 0.03, guides: Sequence[np.ndarray] | None = None
) -> list[np.ndarray]:
    """Crop pictures to their non-white part, each group with its own box, all boxes of one size.

    Args:
        groups: uint8 pictures (..., H, W, 3) of one camera each.
        margin: of the box, relative to the longer side of a picture.
        guides: pictures that determine the boxes, one array for each group; the groups themselves if None.

    Returns:
        The groups, all of one height and width, padded with white.
    """
    boxes = []
    for images in guides or groups:
        flat = images.reshape(-1, *images.shape[-3:])
        visible = (flat < _WHITE).any(axis=(0, 3))
        if not visible.any():
            visible[:] = True
        rows, columns = np.flatnonzero(visible.any(1)), np.flatnonzero(visible.any(0))
        boxes.append((rows[0], rows[-1] + 1, columns[0], columns[-1] + 1))
    pad = round(margin * max(max(images.shape[-3:-1]) for images in groups))
    height = max(bottom - top for top, bottom, _, _ in boxes) + 2 * pad
    width = max(right - left for _, _, left, right in boxes) + 2 * pad
    cut = []
    for images, (_, bottom, left, right) in zip(groups, boxes, strict=True):
        # Indices in the padded picture. Boxes are aligned at the lower edge of the bodies.
        row = bottom + pad
        column = (left + right - width) // 2 + width
        border = [(0, 0)] * (images.ndim - 3) + [(height, height), (width, width), (0, 0)]
        padded = np.pad(images, border, constant_values=255)
        cut.append(padded[..., row : row + height, column : column + width, :])
    return cut
