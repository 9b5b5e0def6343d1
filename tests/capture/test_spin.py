"""Spin: exact from exact paths, within its deviation with noise, and from drawn pictures of a turning ball."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from neuma_lib.capture.motion.free_fall import FreeFall, Track
from neuma_lib.capture.motion.gravity import GRAVITY
from tests.support.board_pictures import looking_at

pytest.importorskip("cv2")

from neuma_lib.capture.motion.spin import PIXEL_SPREAD, Path, fit_spin, follow  # noqa: E402

WIDTH, HEIGHT = 240, 200
K = np.array([[400.0, 0, WIDTH / 2], [0, 400, HEIGHT / 2], [0, 0, 1]])
RADIUS, SPIN = 0.12, np.array([1.5, -2.0, 1.0])
FALL = FreeFall(
    x0=np.array([0.0, 0.65, 0.0]),
    v0=np.array([0.1, 0.0, 0.0]),
    a=np.array([0.0, -GRAVITY, 0.0]),
    offsets=np.array([0.0, 0.003]),
    covariance=np.zeros((10, 10)),
    start=2.0,
    rms=0.0,
    views="triangulated",
)


def camera(position, times):
    view = looking_at(position, (0, 0.55, 0), up=(0, 1, 0))
    return Track(times, np.zeros((len(times), 2)), view, K, "a.mp4")


def cameras(count=16, rate=120):
    times = 2 + np.arange(count) / rate
    return [camera(np.array([1.0, 0.6, 0.2]), times), camera(np.array([-0.1, 0.7, 1.1]), times - 0.003)]


def exact_paths(tracks, noise=0.0, rng=None, shape=(1.0, 1.0, 1.0), points=40):
    """Of random points on the side that faces each camera."""
    rng = rng or np.random.default_rng(0)
    paths = []
    for number, track in enumerate(tracks):
        eye = -track.viewmat[:3, :3].T @ track.viewmat[:3, 3]
        for begin in (0, 4, 8):
            clock = track.times[begin : begin + 8] + FALL.offsets[number]
            centre = FALL.place(clock)
            normals = rng.normal(size=(points // 2, 3))
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            for normal in normals[normals @ (eye - centre[0]) > 0.4 * np.linalg.norm(eye - centre[0])]:
                arm = RADIUS * normal * shape
                x = centre + Rotation.from_rotvec((clock - clock[0])[:, None] * SPIN).apply(arm)
                p = (x @ track.viewmat[:3, :3].T + track.viewmat[:3, 3]) @ K.T
                places = p[:, :2] / p[:, 2:] + noise * rng.normal(size=(len(clock), 2))
                depth = (centre[0] - eye) @ track.viewmat[2, :3]
                paths.append(Path(number, track.times[begin : begin + 8], places, 400 * RADIUS / depth))
    return paths


def test_exact_paths_on_a_sphere_give_the_spin():
    tracks = cameras()
    result = fit_spin(exact_paths(tracks), tracks, FALL)
    # The sphere's outline is seen a little before its middle, so that its radius is taken 1 % too small.
    np.testing.assert_allclose(result.velocity, SPIN, atol=0.03)
    assert result.rms < 0.02


def test_depths_are_fitted_where_the_object_is_no_sphere():
    tracks = cameras()
    result = fit_spin(exact_paths(tracks, shape=(1.3, 0.8, 1.0)), tracks, FALL)
    np.testing.assert_allclose(result.velocity, SPIN, atol=0.1)


def test_noise_stays_within_the_deviation():
    tracks, rng = cameras(), np.random.default_rng(4)
    z = []
    for _ in range(12):
        result = fit_spin(exact_paths(tracks, PIXEL_SPREAD, rng), tracks, FALL)
        z.append((result.velocity - SPIN) / np.sqrt(np.diag(result.covariance)))
    # The deviation is a bound rather than an estimate: errors of a path are taken to be alike.
    assert np.abs(np.mean(z)) < 0.6 and np.square(z).mean() < 1.3


def test_a_ball_at_rest_in_itself_has_no_spin_and_a_smooth_one_shows_none():
    tracks = cameras()
    paths = exact_paths(tracks)
    assert fit_spin(paths[:5], tracks, FALL) is None
    frames = [np.full((HEIGHT, WIDTH, 3), 90, np.uint8)] * 6
    masks = np.zeros((6, HEIGHT, WIDTH), bool)
    masks[:, 60:120, 60:120] = True
    assert follow(frames, masks, np.arange(6) / 120, 0) == []


def drawn(track, number):
    """A ball with grain on it, cast ray by ray."""
    grain = ndimage.gaussian_filter(np.random.default_rng(7).normal(size=(64, 64, 64)), 1.2)
    grain = 128 + 60 * grain / grain.std()
    eye = -track.viewmat[:3, :3].T @ track.viewmat[:3, 3]
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = (
        np.stack([(x - K[0, 2]) / 400, (y - K[1, 2]) / 400, np.ones_like(x)], axis=-1) @ track.viewmat[:3, :3]
    )
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    frames, masks = [], []
    for clock in track.times + FALL.offsets[number]:
        arm = eye - FALL.place([clock])[0]
        b = rays @ arm
        root = b * b - (arm @ arm - RADIUS**2)
        mask = root > 0
        hit = arm + (-b - np.sqrt(np.maximum(root, 0)))[..., None] * rays
        body = Rotation.from_rotvec((clock - FALL.start) * SPIN).inv().apply(hit[mask])
        picture = np.full((HEIGHT, WIDTH), 40.0)
        picture[mask] = ndimage.map_coordinates(grain, (body / RADIUS * 28 + 32).T, order=1)
        frames.append(np.repeat(np.clip(picture, 0, 255).astype(np.uint8)[..., None], 3, axis=2))
        masks.append(mask)
    return frames, np.array(masks)


def test_the_spin_of_a_drawn_ball_is_found_within_a_tenth():
    tracks = cameras()
    paths = [p for k, track in enumerate(tracks) for p in follow(*drawn(track, k), track.times, k)]
    result = fit_spin(paths, tracks, FALL)
    assert np.linalg.norm(result.velocity - SPIN) < 0.1 * np.linalg.norm(SPIN)
    size, deviation = result.rate
    assert abs(size - np.linalg.norm(SPIN)) < 4 * deviation < 1.0
