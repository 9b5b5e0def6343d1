"""A coloured body of Gaussians that falls, spinning, in front of cameras that differ in gain, offset and noise."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from neuma_lib.capture.registration.registration import Parabola
from neuma_lib.capture.registration.rigid_motion import RigidMotion, moment_of_inertia
from neuma_lib.capture.registration.rigid_views import Sight
from neuma_lib.splatting.cameras import look_at
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.rasterizer import rasterize
from neuma_lib.splatting.spherical_harmonics import SH_C0

GRAVITY = np.array([0.0, -9.81, 0.0])
PLACE, VELOCITY = np.array([0.48, 0.62, 0.53]), np.array([0.25, -0.4, -0.15])
SPIN = np.array([1.5, -2.5, 2.0])
SIZE = (160, 120)
GAINS = np.array([[0.8, 0.9, 1.0], [1.1, 1.0, 0.85], [1.0, 1.0, 1.0]])
EYES = np.array([[0.5, 0.75, 1.5], [1.45, 0.7, 0.4], [-0.2, 0.9, -0.2]])


@dataclass
class FlightBody:
    """Gaussians and particles as photographed."""

    gaussians: Gaussians
    particles: np.ndarray
    mass: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray

    @property
    def pivot(self):
        return self.mass @ self.particles / self.mass.sum()


def ellipsoid_body(count=500, radii=(0.06, 0.04, 0.05), coloured=True, bump=0.5, seed=0) -> FlightBody:
    """An ellipsoid with a knob, its colour a smooth function of the place; with ``bump`` 0 and one radius, a ball."""
    rng = np.random.default_rng(seed)
    k = np.arange(count) + 0.5
    up = 1 - 2 * k / count
    around = np.pi * (1 + 5**0.5) * k
    normal = np.stack([np.sqrt(1 - up**2) * np.cos(around), up, np.sqrt(1 - up**2) * np.sin(around)], axis=1)
    knob = bump * np.exp(-((normal - np.array([0.8, 0.6, 0.0])) ** 2).sum(axis=1) / 0.15)
    at = normal * np.array(radii) * (1 + knob[:, None])
    photographed = np.array([0.5, 0.06, 0.5])
    colour = np.full((count, 3), (0.7, 0.5, 0.3))
    if coloured:
        phases = rng.uniform(0, 2 * np.pi, (3, 1))
        colour = 0.5 + 0.4 * np.sin((2.5 * normal @ rng.normal(size=(3, 3))).T + phases).T
    quats = np.array([Rotation.from_matrix(_frame(n)).as_quat()[[3, 0, 1, 2]] for n in normal])
    spacing = np.sqrt(4 * np.pi * np.mean(np.array(radii) ** 2) / count)
    gaussians = Gaussians(
        means=torch.tensor(at + photographed).float(),
        quats=torch.tensor(quats).float(),
        scales=torch.tensor(spacing * np.array([0.7, 0.7, 0.15])).float().repeat(count, 1),
        opacities=torch.full((count,), 0.95),
        sh0=torch.tensor((colour - 0.5) / SH_C0).float()[:, None],
        shN=torch.zeros(count, 0, 3),
    )
    inside = rng.normal(size=(800, 3))
    inside *= rng.uniform(size=(800, 1)) ** (1 / 3) / np.linalg.norm(inside, axis=1, keepdims=True)
    outward = inside / np.linalg.norm(inside, axis=1, keepdims=True)
    grown = 1 + bump * np.exp(-((outward - (0.8, 0.6, 0)) ** 2).sum(axis=1) / 0.15)
    return FlightBody(gaussians, inside * radii * grown[:, None] + photographed, np.ones(800), normal, colour)


def _frame(normal):
    """Axes (3, 3), columns, the last of which is the normal."""
    x = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x), normal], axis=1)


def lit(albedo, normals):
    """Colours under two lamps and the sky, (N, 3)."""
    lamps = np.array([[0.3, 0.9, 0.3], [-0.8, 0.5, 0.3]]) / np.array([[0.995], [0.99]])
    light = np.maximum(normals @ lamps.T, 0) @ (0.5, 0.25) + 0.25 + 0.1 * normals[:, 1]
    return np.clip(albedo * light[:, None], 0, 1)


def photographed_in_light(body: FlightBody) -> FlightBody:
    """The body with the light of its photographs in its colours, and grey where it lay on the floor."""
    colour = lit(body.albedo, body.normals)
    colour[body.normals[:, 1] < -0.6] = 0.25
    g = body.gaussians
    return replace(body, gaussians=replace(g, sh0=torch.tensor((colour - 0.5) / SH_C0).float()[:, None]))


def true_motion(body: FlightBody, rotation, spin=SPIN) -> RigidMotion:
    inertia = moment_of_inertia(body.particles - body.pivot, body.mass)
    return RigidMotion(np.asarray(rotation), PLACE, VELOCITY, np.asarray(spin, float), GRAVITY, inertia)


def filmed(
    body: FlightBody,
    motion: RigidMotion,
    views=2,
    frames=12,
    rate=120.0,
    offset=0.0,
    noise=0.0,
    size=SIZE,
    seed=0,
    light=False,
):
    """`Sight`s of a flight. The clock of the second camera is ``offset`` behind, which they do not contain."""
    rng, width, height = np.random.default_rng(seed), *size
    focal = 1.1 * width
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    middle = motion.place(np.array([frames / rate / 2]))[0][0]
    viewmats = look_at(
        torch.tensor(EYES), torch.tensor(middle), torch.tensor([0.0, 1.0, 0.0]).double()
    ).numpy()
    g, sights = body.gaussians, []
    for k in range(views):
        clock = np.arange(frames) / rate + (0.002 if k else 0.0)
        R, _ = motion.turn(clock)
        c, _ = motion.place(clock)
        R, c = torch.tensor(R).float(), torch.tensor(c).float()
        means = (g.means - torch.tensor(body.pivot).float()) @ R.mT + c[:, None]
        covars = R[:, None] @ g.covars() @ R[:, None].mT
        pictures = []
        for m, c, turn in zip(means, covars, R.numpy()):
            sh = g.sh()
            if light:
                shaded = lit(body.albedo, body.normals @ turn.T)
                sh = torch.tensor((shaded - 0.5) / SH_C0).float()[:, None]
            pictures.append(rasterize(
                m[None], c[None], g.opacities, sh, torch.tensor(viewmats[k : k + 1]).float(),
                torch.tensor(K[None]).float(), width, height, background=(0.0, 0.0, 0.0), eps2d=0.0,
            ))  # fmt: skip
        image, alpha = (torch.cat(parts) for parts in zip(*pictures))
        a = alpha[:, 0].numpy()[..., None]
        colour = GAINS[k] * image[:, 0].numpy() / np.maximum(a, 1e-6) + noise * rng.normal(
            size=(*a.shape[:3], 3)
        )
        a = a + (noise * rng.normal(size=a.shape) if noise else 0.0) * (a > 0.02)
        rgba = np.clip(np.concatenate([colour, a], axis=-1), 0, 1)
        rgba[a[..., 0] <= 0.02] = 0
        images = np.rint(255 * rgba).astype(np.uint8)
        late = offset if k == 1 else 0.0
        sights.append(
            Sight("abc"[k], 3.0 + clock - late, images, viewmats[k], K, 0.0, k == 0 or offset is None)
        )
    return sights


def guess(spin=None) -> Parabola:
    """A parabola as fitted to masks, with errors of millimetres and centimetres per second."""
    off = np.array([0.004, -0.003, 0.005])
    return Parabola(3.0, PLACE + off, VELOCITY + 3 * off, GRAVITY, spin)
