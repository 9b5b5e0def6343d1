"""Geometry of the demo captures: cameras, the board, the object at rest and at the start of its drops.

The world is the simulation box: y up, the floor at y = 0, x along the board's width and z against its height. Positions
in the settings are relative to the middle of the floor.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from neuma_lib.geometry import shapes
from studies.capture_benchmark.settings import (
    DemoCapturesConfig,
    DemoDropConfig,
    DemoObjectConfig,
    LensConfig,
)

MIDDLE = np.array([0.5, 0.0, 0.5])  # the middle of the floor in the simulation box [m]
POLYNOMIAL = 4  # degree of the lens polynomial, from distance in the picture to angle
BEYOND = 1.05  # range of the polynomial fit, relative to the distance of the picture's corners


@dataclass(frozen=True, eq=False)
class Eye:
    """A camera: camera to world (4, 4), OpenGL axes, and the settings of its lens."""

    c2w: np.ndarray
    lens: LensConfig

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) of points (N, 3) [m] in front of the camera, pixel centres at +0.5."""
        seen = (points - self.c2w[:3, 3]) @ self.c2w[:3, :3]
        flat = seen[:, :2] / -seen[:, 2:] * [1.0, -1.0]
        r2 = (flat**2).sum(axis=1, keepdims=True)
        k1, k2 = self.lens.distortion
        return self.lens.focal * flat * (1 + r2 * (k1 + r2 * k2)) + self.lens.center

    def plain(self) -> dict:
        """Pose and intrinsics as in a transforms.json, with k1 and k2."""
        lens = self.lens
        return {
            "transform_matrix": self.c2w.tolist(),
            **{"fl_x": lens.focal, "fl_y": lens.focal, "cx": lens.center[0], "cy": lens.center[1]},
            **{"w": lens.width, "h": lens.height, "k1": lens.distortion[0], "k2": lens.distortion[1]},
        }


def lens_row(lens: LensConfig) -> np.ndarray:
    """A lens for Cycles: a polynomial from distance in the picture to angle, centred in a larger picture.

    Returns:
        Width and height of the lens's picture and of the larger picture, left and top of the former in the latter [px],
        and the coefficients k0 to k4 [rad / px^n], (11,). The fit is within 0.01 px for lenses of phones.
    """
    cx, cy = lens.center
    half = np.array([max(cx, lens.width - cx), max(cy, lens.height - cy)])
    full = 2 * half  # whole pixels, since the centre is in the middle of one or between two
    reach = BEYOND * np.linalg.norm(half)
    slope = np.linspace(0, 3 * reach / lens.focal, 20_000)
    k1, k2 = lens.distortion
    distance = lens.focal * slope * (1 + slope**2 * (k1 + slope**2 * k2))
    kept = slice(0, int(np.argmax(distance > reach)))
    powers = (distance[kept, None] / reach) ** np.arange(1, POLYNOMIAL + 1)
    scaled = np.linalg.lstsq(powers, np.arctan(slope[kept]), rcond=None)[0]
    coefficients = scaled / reach ** np.arange(1, POLYNOMIAL + 1)
    return np.array([lens.width, lens.height, *full, *(full / 2 - [cx, cy]), 0.0, *coefficients])


def looking(place: Sequence[float], target: Sequence[float], roll: float = 0.0) -> np.ndarray:
    """Camera to world (4, 4), OpenGL axes, rotated by ``roll`` [rad] about the viewing direction."""
    place, target = np.asarray(place, float), np.asarray(target, float)
    back = (place - target) / np.linalg.norm(place - target)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    pose = np.eye(4)
    pose[:3, 0] = np.cos(roll) * right + np.sin(roll) * up
    pose[:3, 1] = np.cos(roll) * up - np.sin(roll) * right
    pose[:3, 2], pose[:3, 3] = back, place
    return pose


def video_cameras(demo: DemoCapturesConfig) -> dict[str, Eye]:
    """The fixed cameras, sorted by name."""
    return {
        name: Eye(looking(MIDDLE + c.place, MIDDLE + c.target), c.lens.resized(demo.resolution))
        for name, c in sorted(demo.cameras.items())
    }


def photographers(demo: DemoCapturesConfig, name: str) -> list[Eye]:
    """Cameras of the photographs of an object: rings, and some next to the video cameras."""
    settings = demo.photographs
    rng = np.random.default_rng([demo.seed, *name.encode()])
    target = MIDDLE + settings.target
    places = []
    for ring, (count, elevation, distance) in enumerate(
        zip(settings.rings, np.radians(settings.elevations), settings.distances)
    ):
        for k in range(count):
            around = 2 * np.pi * (k + 0.5 * ring) / count
            flat = np.cos(elevation) * np.array([np.sin(around), 0.0, np.cos(around)])
            places.append(target + distance * (flat + [0.0, np.sin(elevation), 0.0]))
    for camera in video_cameras(demo).values():
        # Closer to the scene, since phones have a wider view than the video cameras.
        places += [target + 0.85 * (camera.c2w[:3, 3] - target)] * settings.beside_cameras
    lens = settings.lens.resized(demo.resolution)
    eyes = []
    for number, place in enumerate(places):
        moved, aimed = rng.normal(0, settings.shake, (2, 3))
        roll = rng.normal(0, 0.04) + (np.pi / 2 if number % settings.upright == settings.upright - 1 else 0.0)
        eyes.append(Eye(looking(place + moved, target + aimed, roll), lens))
    return eyes


@dataclass(frozen=True, eq=False)
class Pose:
    """A rigid motion x -> rotation x + translation, with rotation (3, 3) and translation (3,) [m]."""

    rotation: np.ndarray
    translation: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        return points @ self.rotation.T + self.translation

    def after(self, first: "Pose") -> "Pose":
        """The composition: first ``first``, then this one."""
        return Pose(self.rotation @ first.rotation, self.rotation @ first.translation + self.translation)

    def inverse(self) -> "Pose":
        return Pose(self.rotation.T, -self.rotation.T @ self.translation)

    def plain(self) -> dict:
        return {"rotation": self.rotation.tolist(), "translation": self.translation.tolist()}


def solid(item: DemoObjectConfig) -> trimesh.Trimesh:
    """The object's mesh around the origin [m]."""
    return shapes.build(item.shape, item.size)


def lying(item: DemoObjectConfig, mesh: trimesh.Trimesh) -> Pose:
    """Pose of the object in its photographs: the stable pose reached from the mesh's own orientation."""
    corners = mesh.convex_hull.vertices - mesh.center_mass

    def lift(tilt: np.ndarray) -> float:
        """Height of the centre of mass above the floor."""
        return -(corners @ _upward(tilt)).min()

    tilt = minimize(lift, (0.0, 0.0), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12}).x
    level = Rotation.align_vectors([[0.0, 1.0, 0.0]], [_upward(tilt)])[0].as_matrix()
    turn = Rotation.from_euler("y", item.heading, degrees=True).as_matrix() @ level
    return _put(mesh, turn, item.place, 0.0)


def _upward(tilt: np.ndarray) -> np.ndarray:
    """The unit vector (3,) tilted from +y by two angles, about z and about x [rad]."""
    return Rotation.from_rotvec([tilt[1], 0.0, tilt[0]]).apply([0.0, 1.0, 0.0])


def start(item: DemoObjectConfig, drop: DemoDropConfig, mesh: trimesh.Trimesh) -> Pose:
    """Pose of the object at the start of a drop."""
    turn = Rotation.from_euler("xyz", drop.turn, degrees=True).as_matrix() @ lying(item, mesh).rotation
    return _put(mesh, turn, drop.center, drop.height)


def _put(mesh: trimesh.Trimesh, turn: np.ndarray, center: Sequence[float], height: float) -> Pose:
    points = mesh.vertices @ turn.T
    low, high = points.min(axis=0), points.max(axis=0)
    middle = (low + high) / 2
    return Pose(turn, MIDDLE + [center[0] - middle[0], height - low[1], center[1] - middle[2]])


def frame_steps(demo: DemoCapturesConfig, camera: str) -> np.ndarray:
    """Simulation steps at the middle of the exposures of a camera's frames, (T,)."""
    return demo.cameras[camera].late + demo.truth.steps * np.arange(demo.videos.frames)


def time_step(demo: DemoCapturesConfig) -> float:
    """Time step of the ground truth [s]."""
    return 1.0 / (demo.videos.rate * demo.truth.steps)
