"""Lens and place of a fixed camera against points of photographs: from exact and noisy pixels of a known scene."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from neuma_lib.capture.calibration import resection
from neuma_lib.capture.calibration.lens import Lens
from neuma_lib.capture.calibration.placement import camera_centres
from tests.support.board_pictures import LENS, looking_at

TRUE = Lens(
    640, 480, np.array([[600.0, 0, 326.0], [0, 600.0, 235.0], [0, 0, 1]]), np.array([-0.08, 0.02, 0, 0, 0])
)
EYE = looking_at([-0.8, -0.5, 0.5], [0.1, 0.1, 0.1])
GUESS = Lens(640, 480, np.array([[606.0, 0, 320.0], [0, 606.0, 240.0], [0, 0, 1]]), np.zeros(5))


def scene(height, count=400):
    """Points on a floor, and as many up to a height above it."""
    rng = np.random.default_rng(4)
    flat = np.column_stack([rng.uniform(-0.4, 0.9, (2 * count, 2)), np.zeros(2 * count)])
    flat[count:, 2] = rng.uniform(0, height, count)
    return flat


def sightings(points, noise):
    """Of 12 cameras around the scene, and of the fixed one."""
    rng = np.random.default_rng(5)
    eyes = [looking_at([np.cos(a), np.sin(a), 0.6], [0.1, 0.1, 0.0]) for a in np.linspace(0, 6, 12)]
    results = []
    for lens, eye in [(LENS, eye) for eye in eyes] + [(TRUE, EYE)]:
        pixels = lens.project(points @ eye[:3, :3].T + eye[:3, 3])
        inside = np.flatnonzero(((pixels > 0) & (pixels < [lens.width, lens.height])).all(axis=1))
        noisy = pixels[inside] + rng.normal(0, noise, (len(inside), 2))
        results.append(resection.Sighting(lens, eye, inside, noisy))
    return results


def resected(height, noise, outliers=0):
    points = scene(height)
    *photographs, still = sightings(points, noise)
    rng = np.random.default_rng(6)
    result, covariances, known = resection.triangulated(
        points + rng.normal(0, 0.003, points.shape), photographs
    )
    chosen = known[still.points]
    numbers, pixels = still.points[chosen], still.pixels[chosen].copy()
    pixels[:outliers] += rng.uniform(20, 60, (outliers, 2))
    near = EYE.copy()
    near[:3, :3] = Rotation.from_rotvec([0.008, -0.01, 0.003]).as_matrix() @ EYE[:3, :3]
    near[:3, 3] += [0.01, -0.005, 0.012]
    return resection.resect(result[numbers], covariances[numbers], pixels, GUESS, near)


def turned(viewmat):
    return np.degrees(Rotation.from_matrix(viewmat[:3, :3] @ EYE[:3, :3].T).magnitude())


def test_points_are_where_the_photographs_saw_them_with_the_deviations_of_noise():
    points = scene(0.3)
    *photographs, _ = sightings(points, 0.3)
    result, covariances, known = resection.triangulated(points + 0.004, photographs)
    off = result[known] - points[known]
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariances[known]), off)
    assert known.mean() > 0.95
    assert squares.mean() == pytest.approx(3, rel=0.15)  # chi-squared with three degrees of freedom
    alone = resection.triangulated(points, photographs[:1])[2]
    assert not alone.any()


def test_an_exact_picture_gives_the_camera_though_the_lens_is_off_its_centre():
    camera = resected(0.4, 1e-3)
    np.testing.assert_allclose(camera.lens.K, TRUE.K, atol=0.1)
    np.testing.assert_allclose(camera.lens.distortion, TRUE.distortion, atol=1e-3)
    assert turned(camera.viewmat) < 0.01
    off = camera_centres(np.stack([camera.viewmat, EYE]))
    assert np.linalg.norm(off[0] - off[1]) < 2e-4


def test_noise_and_outliers_stay_within_the_deviations_that_are_stated():
    camera = resected(0.4, 0.3, outliers=40)
    off = camera.lens.K[:2, 2] - TRUE.K[:2, 2]
    assert (np.abs(off) < 3 * camera.centre_deviation).all() and camera.centre_deviation.max() < 1.5
    assert turned(camera.viewmat) < min(0.2, 3 * camera.turn_deviation)


def test_a_floor_alone_does_not_determine_the_centre_and_warns():
    flat, tall = resected(0.0, 0.3), resected(0.4, 0.3)
    assert flat.turn_deviation > 3 * tall.turn_deviation
    off = flat.lens.K[:2, 2] - TRUE.K[:2, 2]
    assert (np.abs(off) < 3 * flat.centre_deviation).all()
    assert flat.centre_deviation.max() <= 1.01 * resection.OFF_CENTRE * TRUE.width
