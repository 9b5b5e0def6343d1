"""Drawn photographs of a figure among furniture and other figures, with true masks and points as of COLMAP.

Rays meet ellipsoids and boxes in closed form. Surfaces have solid textures, a lamp and its shadows.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from tests.support.board_pictures import looking_at

WIDTH, HEIGHT, FOCAL = 320, 240, 340.0
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
_LAMP = np.array([1.2, 2.4, -0.7])
_EPSILON = 1e-4


@dataclass
class Part:
    """An ellipsoid or box with half axes (3,) in a rotation (3, 3), and two colours of a texture of a grain [m]."""

    centre: np.ndarray
    half: np.ndarray
    rotation: np.ndarray
    box: bool
    colours: np.ndarray
    grain: float
    target: bool = False

    def meet(self, eyes, rays):
        """Distances along rays (N, 3) to the surface, inf without one."""
        o = (eyes - self.centre) @ self.rotation / self.half
        d = rays @ self.rotation / self.half
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.box:
                a, b = (-1 - o) / d, (1 - o) / d
                near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
                t = np.where(near > _EPSILON, near, far)
                return np.where((far > near) & (t > _EPSILON), t, np.inf)
            A, B, C = (d * d).sum(axis=1), (o * d).sum(axis=1), (o * o).sum(axis=-1) - 1
            root = np.sqrt(B * B - A * C)
            t = np.where((-B - root) / A > _EPSILON, (-B - root) / A, (-B + root) / A)
            return np.where((root >= 0) & (t > _EPSILON), t, np.inf)

    def may_meet(self, eye, rays):
        """Rays (N, 3) from a point that pass the sphere around the part."""
        away = self.centre - eye
        along = rays @ away / (rays * rays).sum(axis=1)
        off = away - along[:, None] * rays
        return (along > 0) & (
            (off * off).sum(axis=1) < (self.half @ self.half if self.box else self.half.max() ** 2)
        )

    def normals(self, points):
        local = (points - self.centre) @ self.rotation / self.half
        if self.box:
            local = np.where(np.abs(local) == np.abs(local).max(axis=1, keepdims=True), np.sign(local), 0.0)
        n = local / self.half @ self.rotation.T
        return n / np.linalg.norm(n, axis=1, keepdims=True)

    def albedo(self, points, lattice):
        local = (points - self.centre) @ self.rotation
        v = 0.6 * _noise(local / self.grain, lattice) + 0.4 * _noise(local / (0.4 * self.grain) + 7, lattice)
        v = np.clip(1.8 * v - 0.4, 0, 1)[:, None]
        return self.colours[0] + v * (self.colours[1] - self.colours[0])


@dataclass
class Room:
    """Photographs (H, W, 3), true masks (H, W), cameras, points (P, 3) and which photographs show each (N, P)."""

    pictures: list
    masks: list
    viewmats: np.ndarray
    Ks: np.ndarray
    points: np.ndarray
    seen: np.ndarray


def _noise(p, lattice):
    cell = np.floor(p).astype(int)
    f = p - cell
    f = f * f * (3 - 2 * f)
    total = np.zeros(len(p))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, f, 1 - f), axis=1)
        i, j, k = ((cell + corner) % len(lattice)).T
        total += weight * lattice[i, j, k]
    return total


def _turn(rng, upright):
    angle = rng.uniform(0, 2 * np.pi)
    c, s = np.cos(angle), np.sin(angle)
    yaw = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return yaw if upright else yaw @ np.linalg.qr(rng.normal(size=(3, 3)))[0]


def _colours(rng, near=None):
    """Two colours, the first near a given one."""
    first = rng.uniform(30, 230, 3) if near is None else np.clip(near + rng.normal(0, 12, 3), 10, 245)
    return np.stack([first, np.clip(first * rng.uniform(0.4, 1.6) + rng.normal(0, 40, 3), 5, 250)])


def _figure(rng, place, size, colour=None, target=False):
    """Ellipsoids of a toy of a size [m] on the floor at a place (x, z)."""
    middle = np.array([place[0], 0.0, place[1]])
    body = size * rng.uniform([0.22, 0.26, 0.18], [0.32, 0.34, 0.28])
    head = size * rng.uniform(0.16, 0.24)
    coat, skin = _colours(rng, colour), _colours(rng)
    turn = _turn(rng, True)
    shapes = [
        ((0, body[1], 0), body, coat),
        ((0, 2 * body[1] + 0.7 * head, 0), np.full(3, head) * rng.uniform(0.85, 1.15, 3), skin),
    ]
    arm, ear = size * np.array([0.07, 0.16, 0.07]), size * np.array([0.06, 0.12, 0.04])
    for side in (-1, 1):
        at = side * 0.95 * body[0], body[1] * rng.uniform(0.8, 1.4), 0.3 * body[2]
        shapes.append((at, arm, skin))
        if rng.random() < 0.7:
            top = 2 * body[1] + 1.5 * head
            shapes.append(((side * 0.7 * head, top, 0), ear, coat))
    grain = size * rng.uniform(0.05, 0.2)
    return [
        Part(middle + turn @ np.array(at), np.asarray(half), turn, False, colours, grain, target)
        for at, half, colours in shapes
    ]


def cluttered_room(seed, views=20):
    """A room with a figure at the origin, and furniture and figures around it."""
    rng = np.random.default_rng(seed)
    size = rng.uniform(0.26, 0.36)
    coat = rng.uniform(30, 230, 3)
    parts = _figure(rng, (0, 0), size, coat, True)
    for place, half in (
        ((0, -0.05, 0), (3, 0.05, 3)),
        ((0, 1.3, 2.2), (3, 1.5, 0.05)),
        ((0, 1.3, -2.2), (3, 1.5, 0.05)),
        ((2.2, 1.3, 0), (0.05, 1.5, 3)),
        ((-2.2, 1.3, 0), (0.05, 1.5, 3)),
    ):
        parts.append(
            Part(
                np.array(place, float),
                np.array(half, float),
                np.eye(3),
                True,
                _colours(rng),
                rng.uniform(0.02, 0.12),
            )
        )
    start, count = rng.uniform(0, 2 * np.pi), 12
    for i in range(count):
        angle = start + 2 * np.pi * (5 * i % count) / count + rng.normal(0, 0.1)
        away = (
            rng.uniform(0.38, 0.45) if i == 0 else rng.uniform(0.5, 0.8) if i < 8 else rng.uniform(0.9, 1.6)
        )
        place = away * np.array([np.cos(angle), np.sin(angle)])
        near = coat if i == 1 else None
        if i % 2:
            parts += _figure(rng, place, rng.uniform(0.15, 0.4), near)
        else:
            low, high = (
                ((0.05, 0.02, 0.05), (0.16, 0.12, 0.12)) if away < 0.9 else ((0.1, 0.2, 0.1), (0.3, 0.7, 0.3))
            )
            half = rng.uniform(low, high)
            colours, grain = _colours(rng, near), rng.uniform(0.01, 0.06)
            middle = np.array([place[0], half[1], place[1]])
            parts.append(Part(middle, half, _turn(rng, True), True, colours, grain))
    lattice = rng.random((32, 32, 32))
    eyes, viewmats = [], []
    for i in range(views):
        angle = 2 * np.pi * i / views + rng.normal(0, 0.05)
        up = np.radians(rng.uniform(18, 32) if i % 2 else rng.uniform(40, 58))
        away = rng.uniform(0.95, 1.25)
        eye = away * np.array([np.cos(up) * np.cos(angle), np.sin(up), np.cos(up) * np.sin(angle)])
        aim = np.array([0, 0.45 * size, 0]) + rng.normal(0, 0.05, 3)
        eyes.append(eye)
        viewmats.append(looking_at(eye, aim, up=(rng.normal(0, 0.05), 1.0, rng.normal(0, 0.05))))
    viewmats = np.stack(viewmats)
    drawn = [_draw(parts, view, lattice, rng) for view in viewmats]
    points, seen = _points([d[2] for d in drawn], [d[3] for d in drawn], viewmats, rng)
    return Room(
        [d[0] for d in drawn], [d[1] for d in drawn], viewmats, np.tile(K, (views, 1, 1)), points, seen
    )


def _cast(parts, eye, rays):
    """Distances (N,) along rays (N, 3) from a point to the nearest part, and its number."""
    best, which = np.full(len(rays), np.inf), np.full(len(rays), -1)
    for k, part in enumerate(parts):
        near = np.flatnonzero(part.may_meet(eye, rays)) if part.half.max() < 1 else np.arange(len(rays))
        t = part.meet(eye, rays[near])
        nearer = t < best[near]
        best[near[nearer]], which[near[nearer]] = t[nearer], k
    return best, which


def _draw(parts, view, lattice, rng):
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(x - K[0, 2]) / FOCAL, (y - K[1, 2]) / FOCAL, np.ones_like(x)], axis=-1).reshape(-1, 3)
    rays = rays @ view[:3, :3]
    eye = -view[:3, :3].T @ view[:3, 3]
    t, which = _cast(parts, eye, rays)
    points = eye + np.where(np.isfinite(t), t, 5.0)[:, None] * rays
    light = _cast(parts, _LAMP, points - _LAMP)[0] > 0.995
    light = ndimage.gaussian_filter(light.reshape(HEIGHT, WIDTH).astype(float), 1.5).ravel()
    shade = np.zeros(len(rays))
    albedo = np.zeros((len(rays), 3))
    for k, part in enumerate(parts):
        own = which == k
        if own.any():
            n = part.normals(points[own])
            way = _LAMP - points[own]
            facing = np.clip((n * way).sum(axis=1) / np.linalg.norm(way, axis=1), 0, None)
            shade[own] = 0.38 + 0.1 * n[:, 1] + 0.65 * facing * light[own]
            albedo[own] = part.albedo(points[own], lattice)
    picture = (albedo * shade[:, None]).reshape(HEIGHT, WIDTH, 3) * rng.uniform(0.9, 1.1)
    picture = ndimage.gaussian_filter(picture, (0.6, 0.6, 0)) + rng.normal(0, 2.5, (HEIGHT, WIDTH, 3))
    target = np.array([part.target for part in parts])
    mask = (target[which] & (which >= 0)).reshape(HEIGHT, WIDTH)
    picture = picture.clip(0, 255).round().astype(np.uint8)
    return picture, mask, points.reshape(HEIGHT, WIDTH, 3), (t * 1.0).reshape(HEIGHT, WIDTH)


def _points(places, depths, viewmats, rng, each=120):
    """Surface points that at least three views show, displaced as by 0.5 px, and a few wrong ones."""
    chosen = np.concatenate([p.reshape(-1, 3)[rng.choice(p.shape[0] * p.shape[1], each)] for p in places])
    seen = []
    for view, depth in zip(viewmats, depths):
        local = chosen @ view[:3, :3].T + view[:3, 3]
        pixels = local @ K.T
        pixels = (pixels[:, :2] / np.maximum(pixels[:, 2:], 1e-6)).astype(int)
        within = (local[:, 2] > 0.1) & (pixels >= 0).all(axis=1) & (pixels < (WIDTH, HEIGHT)).all(axis=1)
        column, row = pixels.clip(0, (WIDTH - 1, HEIGHT - 1)).T
        seen.append(within & (np.abs(depth[row, column] - local[:, 2]) < 0.01 * local[:, 2]))
    seen = np.stack(seen) & (rng.random((len(seen), len(chosen))) < 0.5)
    enough = seen.sum(axis=0) >= 3
    chosen = chosen[enough] + rng.normal(0, 0.002, (enough.sum(), 3))
    wrong = rng.random(len(chosen)) < 0.02
    chosen[wrong] += rng.normal(0, 0.3, (wrong.sum(), 3))
    return chosen, seen[:, enough]
