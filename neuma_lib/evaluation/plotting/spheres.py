"""Render particles as shaded spheres, for figures."""

import numpy as np

_LIGHT = np.array([-0.45, -0.75, -0.5]) / np.linalg.norm([-0.45, -0.75, -0.5])
"""Direction towards the light in camera axes (x right, y down, z forward): from above, left, behind the camera."""
_AMBIENT = 0.45  # brightness of a side without light
_SUPERSAMPLING = 2  # samples of a pixel along each axis


def draw_spheres(
    points: np.ndarray,
    colors: np.ndarray,
    radius: float,
    viewmat: np.ndarray,
    K: np.ndarray,
    width: int,
    height: int,
) -> np.ndarray:
    """Render equal spheres over white, with hidden surfaces removed and one distant light.

    Args:
        points: centres [m], shape (N, 3).
        colors: in [0, 1], shape (N, 3) or (3,).
        radius: of every sphere [m], small against its distance.
        viewmat: world to camera, OpenCV axes, shape (4, 4).
        K: intrinsics [px], shape (3, 3).
        width, height: of the picture [px].

    Returns:
        uint8 picture (height, width, 3).
    """
    s = _SUPERSAMPLING
    local = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    ahead = local[:, 2] > radius
    local = local[ahead]
    colors = np.broadcast_to(colors, points.shape)[ahead]
    centre = s * (local @ K.T)[:, :2] / local[:, 2:]  # pixels of the supersampled picture
    reach = s * K[0, 0] * radius / local[:, 2]
    most = int(np.ceil(reach.max(initial=0.0)))
    depth = np.full(width * height * s * s, np.inf, dtype=np.float32)
    hits = []
    corner = np.floor(centre).astype(int)
    for i in range(-most, most + 1):
        for j in range(-most, most + 1):
            pixel = corner + (i, j)
            offset = (pixel + 0.5 - centre) / reach[:, None]
            rest = 1 - (offset**2).sum(1)
            seen = (rest > 0) & (pixel >= 0).all(1) & (pixel < (s * width, s * height)).all(1)
            normal = np.concatenate([offset[seen], -np.sqrt(rest[seen])[:, None]], axis=1)
            z = (local[seen, 2] + radius * normal[:, 2]).astype(np.float32)
            index = pixel[seen, 1] * s * width + pixel[seen, 0]
            np.minimum.at(depth, index, z)
            hits.append((index, z, np.flatnonzero(seen), normal))
    picture = np.ones((len(depth), 3), dtype=np.float32)
    for index, z, sphere, normal in hits:
        front = z <= depth[index]
        light = _AMBIENT + (1 - _AMBIENT) * np.clip(normal[front] @ _LIGHT, 0, None)
        picture[index[front]] = colors[sphere[front]] * light[:, None]
    picture = picture.reshape(height, s, width, s, 3).mean(axis=(1, 3))
    return (255 * picture.clip(0, 1)).round().astype(np.uint8)
