"""Shapes of revolution from drawn silhouettes of turning bodies, and bodies that are none."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

pytest.importorskip("cv2")

from neuma_lib.capture.masks.revolution import fit_revolution  # noqa: E402
from neuma_lib.geometry.outline import silhouette  # noqa: E402
from neuma_lib.io.mesh import read_mesh, write_mesh  # noqa: E402

SIZE = 120
VELOCITIES = np.random.default_rng(0).normal(size=(9, 2))


def bottle():
    line = [[0, -30], [11, -30], [12, -26], [12, 4], [10, 10], [5, 16], [4, 28], [0, 28]]
    return trimesh.creation.revolve(np.array(line, float), sections=96)


BODIES = {
    "bottle": bottle(),
    "disc": trimesh.creation.cylinder(radius=24, height=10, sections=96),
    "cone": trimesh.creation.cone(radius=18, height=44, sections=96),
    "dumbbell": trimesh.creation.revolve(
        np.array([[0, -30], [14, -30], [14, -16], [5, -14], [5, 14], [14, 16], [14, 30], [0, 30]], float),
        sections=96,
    ),
}


def drawn(mesh, tilts, seed=0):
    """Silhouettes of a mesh whose z axis is tilted out of the picture by angles [deg], turned at random within it."""
    rng = np.random.default_rng(seed)
    masks = []
    for tilt in tilts:
        # The axis from z into the picture plane, tilted, turned about the line of sight, the body about its axis.
        turn = Rotation.from_euler("zxz", [rng.uniform(0, 360), 90 - tilt, rng.uniform(0, 360)], degrees=True)
        points = turn.apply(mesh.vertices - mesh.center_mass)[:, :2] + SIZE / 2 + rng.uniform(-0.5, 0.5, 2)
        masks.append(silhouette(points, mesh.faces, SIZE, SIZE))
    return np.array(masks)


TILTS = [0, 5, 15, 25, 35, 45, 55, 65, 75]


@pytest.mark.parametrize("name", BODIES)
def test_a_turning_body_of_revolution_is_rebuilt(name, tmp_path):
    """Drawing, turning and centring round an end by half a pixel each. A tilt of one step, 5 degrees, adds length."""
    mesh = BODIES[name]
    fit = fit_revolution(drawn(mesh, TILTS), VELOCITIES)
    assert fit.report["agrees"] and not fit.report["ball"]
    rebuilt, (wide, _, length) = fit.mesh, np.ptp(mesh.vertices, axis=0)
    assert np.ptp(rebuilt.vertices[:, 0]) == pytest.approx(wide, abs=3)
    assert np.ptp(rebuilt.vertices[:, 2]) == pytest.approx(length, abs=3 + wide * np.sin(np.radians(5)))
    write_mesh(tmp_path / "shape.ply", rebuilt.vertices, rebuilt.faces)
    assert read_mesh(tmp_path / "shape.ply").volume == pytest.approx(mesh.volume, rel=0.1)


def test_a_ball_is_one():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=14.3)
    fit = fit_revolution(drawn(ball, TILTS), VELOCITIES)
    assert fit.report["agrees"] and fit.report["ball"]
    assert fit.mesh.volume == pytest.approx(ball.volume, rel=0.1)


def test_bodies_without_an_axis_and_blurred_balls_are_refused():
    box = trimesh.creation.box((50, 30, 12))
    rng = np.random.default_rng(1)
    masks = []
    for turn in Rotation.random(9, random_state=2):
        points = turn.apply(box.vertices)[:, :2] + SIZE / 2 + rng.uniform(-0.5, 0.5, 2)
        masks.append(silhouette(points, box.faces, SIZE, SIZE))
    assert not fit_revolution(np.array(masks), VELOCITIES).report["agrees"]
    head = trimesh.creation.icosphere(radius=9).apply_translation([15, 0, 6])
    duck = trimesh.util.concatenate([bottle(), head])
    assert not fit_revolution(drawn(duck, TILTS), VELOCITIES).report["agrees"]
    y, x = np.mgrid[:SIZE, :SIZE] - 60.0
    blurred = [np.hypot(np.maximum(np.abs(x) - 5, 0), y) <= 15] * 9  # a disc that moves by 10 px
    fit = fit_revolution(np.array(blurred), np.tile([1.0, 0.0], (9, 1)))
    assert (
        fit.deviations.max() <= fit.report["limit_px"]
        and fit.report["blur_px"] == pytest.approx(10, abs=1)
        and not fit.report["agrees"]
    )
