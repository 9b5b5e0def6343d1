"""Several bodies on one grid, coloured solids, and densities that differ inside a body."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
import yaml

from neuma_lib.coupling.bodies import coloured_solid, join
from neuma_lib.coupling.particle_binding import bind_two_pass
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.data.ground_truth import TrueBody, change_by_a_doubled_grid, simulate_ground_truth
from neuma_lib.errors import InputError
from neuma_lib.geometry.shapes import place
from neuma_lib.geometry.volume import check_apart, sample_volume
from neuma_lib.io.files import write_json
from neuma_lib.io.gaussians import save_gaussians
from neuma_lib.io.particles import load_initial_state, save_binding, save_particles
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.density import density_at
from neuma_lib.project import cases
from neuma_lib.project.loading import load, merged
from neuma_lib.sim.bodies import Pair
from neuma_lib.sim.model import MPM
from neuma_lib.sim.state import State
from neuma_lib.splatting.cameras import Cameras
from tests.support.errors import refused
from tests.support.render_scenes import dense

ROOT = Path(__file__).resolve().parents[2]
JELLY = {"elasticity": {"name": "fixed_corotated", "E": 1e5, "nu": 0.2}}
SPLIT = {"axis": "x", "at": 0.5, "below": 500.0, "above": 1500.0}
FLOATING = MPM(grid=16, dt=1e-3, gravity=(0.0, 0.0, 0.0))


def solid(x: float, shape: str = "ball", count: int = 150) -> tuple:
    mesh = place(shape, 0.22, 0.5, (x, 0.5))
    points = torch.as_tensor(sample_volume(mesh, count, seed=3), dtype=torch.float32)
    return mesh, points, coloured_solid(mesh, points, 1000.0, torch.full((len(points), 3), 0.5))


def settings(**changes):
    raw = yaml.safe_load((ROOT / "config" / "config.yaml").read_text())
    return load(merged(raw, changes), ROOT)


def test_bodies_of_an_experiment_are_complete():
    bodies = [{"scene": "BouncyBall", "shape": "letter_N", "height": 0.5}, {"scene": "ClayCat"}]
    config = settings(experiments={"x": {"title": "X", "bodies": bodies, "steps": 100}})
    letter, cat = config.experiment_bodies("x")
    ball = config.scene("BouncyBall").plain()
    assert (letter["shape"], letter["height"], letter["size"]) == ("letter_N", 0.5, None)
    assert letter["velocity"] == ball["velocity"] and letter["law"] == ball["law"]
    assert not letter["reconstructed"] and cat["reconstructed"]
    scene = config.scene("ClayCat").plain()
    assert all(cat[key] == scene[key] for key in ("shape", "size", "height", "velocity"))
    assert config.experiment_dt("x") == scene["dt"] < ball["dt"]


def test_mistakes_in_experiments_and_tables_are_named():
    body = {"title": "X", "steps": 10}
    with pytest.raises(InputError, match="experiments.x.bodies.0.scene: no scene 'ClayCats'; did you mean"):
        settings(experiments={"x": {**body, "bodies": [{"scene": "ClayCats"}]}})
    with pytest.raises(InputError, match="height: a reconstructed object starts as in its scene"):
        settings(experiments={"x": {**body, "bodies": [{"scene": "ClayCat", "height": 0.4}]}})
    with pytest.raises(InputError, match="tables.table2.experiments: no experiment 'letter_M_bouncy'"):
        settings(tables={"table2": {"experiments": ["letter_M_bouncy"]}})
    with pytest.raises(InputError, match="at least one scene or experiment"):
        settings(tables={"table2": {"experiments": []}})
    with pytest.raises(InputError, match="scenes.ClayCat.density"):
        settings(scenes={"ClayCat": {"density": {"below": 1.0}}})


def test_density_that_a_method_assumes():
    config = settings()
    own = config.scene("UnevenCat").plain()["density"]
    assert cases.case(config, "UnevenCat", "neuma").density("UnevenCat") == own
    assert cases.case(config, "UnevenCat", "neuma+assumed_density=900").density("UnevenCat") == 900


def test_densities_on_both_sides_of_a_plane():
    x = torch.tensor([[0.4, 0, 0], [0.6, 0, 0], [0.5, 0, 0]])
    assert density_at(x, SPLIT).tolist() == [500, 1500, 1500]
    assert density_at(x, 700.0).tolist() == [700, 700, 700]
    assert density_at(x.double(), {**SPLIT, "axis": "z"}).tolist() == [500] * 3


def test_a_joined_body_renders_and_binds_as_its_parts():
    _, _, left = solid(0.3)
    _, points, plain = solid(0.7)
    kernels = plain.gaussians[torch.arange(len(points)) < 90]
    matrix, x0, _, vol0 = bind_two_pass(kernels.means, 3 * kernels.covars(), points, plain.vol0)
    kernels.shN = torch.randn(90, 3, 3, generator=torch.Generator().manual_seed(0))
    right = Reconstruction(x0, vol0, 1500 * vol0, kernels, matrix)
    both = join([left, right])
    split = len(left.x0)
    torch.testing.assert_close(
        dense(both.binding), torch.block_diag(dense(left.binding), dense(right.binding))
    )
    together = State.joined([body.state([0.0, -3.0, 0.0]) for body in (left, right)])
    assert torch.equal(together.x, both.x0) and torch.equal(together.mass, both.mass)
    assert torch.equal(both.gaussians.sh()[split:], right.gaussians.sh())
    assert not both.gaussians.shN[:split].any()
    with refused("bodies 0 and 1"):
        check_apart([solid(0.5)[0], solid(0.6)[0]])
    check_apart([solid(0.3)[0], solid(0.7)[0]])


def test_a_coloured_solid_covers_its_silhouette_in_its_colour():
    mesh = place("letter_N", None, 0.5, (0.5, 0.5))
    points = torch.as_tensor(sample_volume(mesh, 800, seed=0), dtype=torch.float32)
    body = coloured_solid(mesh, points, 1000.0, torch.tensor([0.2, 0.6, 0.4]).expand(len(points), 3))
    assert float(body.vol0.sum()) == pytest.approx(mesh.volume, rel=1e-5)
    view = torch.eye(4)
    view[:3, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    view[:3, 3] = torch.tensor([-0.5, 0.5, 1.5])
    cameras = Cameras(view[None], torch.tensor([[[90.0, 0, 32], [0, 90.0, 32], [0, 0, 1]]]), 64, 64)
    eye = torch.eye(3).expand(1, len(points), 3, 3)
    image = body.particle_gs(cameras)(points[None], eye)[0, 0]
    # The front faces the camera: the centre of a stroke is opaque, the notch above the diagonal is empty.
    stroke, _ = cameras.project(torch.tensor([[0.39, 0.5, 0.55], [0.54, 0.62, 0.55], [0.2, 0.5, 0.5]]))
    left, notch, outside = (image[int(v), int(u)] for u, v in stroke[0].tolist())
    assert left.max() < 0.75 and left[1] > left[2] > left[0]
    assert outside.min() > 0.99 and notch.min() > 0.8


def test_colliding_bodies_of_different_mass_exchange_momentum():
    """Free of gravity and walls, total momentum stays, and both bodies feel the collision."""
    meshes = [solid(0.34)[0], solid(0.66)[0]]
    bodies = [
        TrueBody(meshes[0], analytic_law(JELLY), (1.0, 0.0, 0.0), 1000.0),
        TrueBody(meshes[1], analytic_law(JELLY), (-1.0, 0.0, 0.0), SPLIT | {"at": 0.66}),
    ]
    truth = simulate_ground_truth(FLOATING, bodies, (0, 40, 80), particles=300, tracers=600, seed=1)
    count = len(sample_volume(meshes[0], 300, seed=1))
    assert set(np.unique((truth.mass / truth.vol0)[count:].round())) == {500.0, 1500.0}
    momentum = (truth.mass[:, None] * truth.path.v).sum(1)
    torch.testing.assert_close(momentum[-1], momentum[0], atol=2e-4 * float(truth.mass.sum()), rtol=0)
    for part in (slice(0, count), slice(count, None)):
        speed = (truth.mass[part, None] * truth.path.v[:, part]).sum(1)[:, 0] / truth.mass[part].sum()
        assert abs(float(speed[-1] - speed[0])) > 0.2
    # Tracers fill both bodies, equally densely.
    left = float((truth.tracers[0, :, 0] < 0.5).float().mean())
    assert left == pytest.approx(0.5, abs=0.04)


def test_separate_bodies_of_a_truth_keep_their_tracers():
    """Of boxes that touch and slide along each other without friction, each tracer moves as its body.

    Their edges, which meet at the start, slow them down by a tenth. As one body the boxes stick.
    """
    boxes = []
    for x in (0.4, 0.6):
        boxes.append(trimesh.creation.box((0.2, 0.2, 0.2)).apply_translation((x, 0.5, 0.5)))
    bodies = [
        TrueBody(mesh, analytic_law(JELLY), (0.0, speed, 0.0)) for mesh, speed in zip(boxes, (0.5, -0.5))
    ]
    model = MPM(16, 1e-3, gravity=(0.0, 0.0, 0.0), pairs=(Pair(0, 1, 0.0),))
    options = dict(particles=500, tracers=400, seed=1)
    truth = simulate_ground_truth(model, bodies, (0, 100), separate=True, **options)
    for owner, points in ((truth.body, truth.path.x), (truth.tracer_body, truth.tracers)):
        assert torch.equal(owner, (points[0, :, 0] > 0.5).long())
        moved = points[-1] - points[0]
        expected = torch.where(owner == 0, 0.05, -0.05)
        assert (moved[:, 1] - expected).abs().max() < 0.025
        for body, sign in enumerate((1, -1)):
            assert float(moved[owner == body, 1].mean()) == pytest.approx(sign * 0.05, rel=0.2)
    again = truth.tracers_again
    torch.testing.assert_close(
        (again[-1] - again[0])[:, 1].sign(), torch.where(again[0, :, 0] < 0.5, 1.0, -1.0), rtol=0, atol=0
    )
    stuck = simulate_ground_truth(replace(model, pairs=()), bodies, (0, 100), **options)
    assert (stuck.path.x[-1] - truth.path.x[-1]).abs().max() > 0.02


def test_a_converged_truth_has_eight_particles_in_a_cell_and_its_file_fewer():
    """The stored particles are drawn from the simulated ones, and represent all of the mass."""
    mesh = solid(0.5)[0]
    body = TrueBody(mesh, analytic_law(JELLY), (0.0, 0.0, 0.0), 1000.0)
    model = MPM(24, 1e-3, gravity=(0.0, 0.0, 0.0))
    options = dict(particles=None, tracers=50, seed=1)
    whole = simulate_ground_truth(
        model, [body, TrueBody(solid(0.2)[0], body.law, body.velocity)], (0, 1), **options
    )
    count = 8 * mesh.volume * 24**3
    assert len(whole.mass) == pytest.approx(2 * count, rel=0.1)
    drawn = simulate_ground_truth(model, [body], (0, 1), stored=100, **options)
    assert drawn.path.x.shape[:2] == (2, 100) and len(drawn.vol0) == 100
    assert float(drawn.mass.sum()) == pytest.approx(1000 * mesh.volume, rel=1e-4)
    every = simulate_ground_truth(model, [body], (0, 1), **options)
    nearest = torch.cdist(drawn.path.x[0], every.path.x[0]).amin(dim=1)
    assert float(nearest.max()) < 1e-3 and float(drawn.path.x[0].std(dim=0).min()) > 0.9 * float(
        every.path.x[0].std(dim=0).min()
    )


def test_the_change_by_a_doubled_grid_is_half_that_from_half_the_grid():
    """Exact for an error of first order: tracers at distances 4 h, 2 h and h from their limit for grids of 1, 2, 4."""
    limit = torch.rand(3, 20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    direction = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    grids = [SimpleNamespace(tracers=limit + error * direction) for error in (0.04, 0.02, 0.01)]
    change = change_by_a_doubled_grid(grids[1], grids[0])
    assert change == pytest.approx(float((grids[2].tracers - grids[1].tracers)[0, 0].norm()))


def test_a_start_has_the_densities_and_motions_of_its_bodies(tmp_path):
    both = join([solid(0.3)[2], solid(0.7)[2]])
    half = len(both.x0) // 2
    save_gaussians(tmp_path / "g.ply", both.gaussians)
    save_binding(tmp_path / "b.h5", both.binding)
    save_particles(tmp_path / "p.h5", both.x0, both.vol0, {})
    still, pivot = {"angular_velocity": [0, 0, 0], "centre": None}, [0.6, 0.5, 0.5]
    spinning = {"v0": [0, 0, 2.0], "angular_velocity": [0, 3.0, 0], "centre": pivot}
    starts = [{"v0": [1.0, 0, 0], **still, "particles": half}, {**spinning, "particles": len(both.x0) - half}]
    files = [tmp_path / name for name in ("p.h5", "b.h5", "g.ply", "v.json")]
    write_json(files[-1], {"bodies": starts})
    start, counts = load_initial_state(*files, [1000.0, {**SPLIT, "axis": "y"}])
    assert counts == [half, len(both.x0) - half]
    assert start.v[:half].unique(dim=0).tolist() == [[1, 0, 0]] and not start.C[:half].any()
    arm = start.x[half:] - torch.tensor(pivot)
    turning = torch.stack([3 * arm[:, 2], torch.zeros(len(arm)), 2 - 3 * arm[:, 0]], dim=1)
    torch.testing.assert_close(start.v[half:], turning)
    torch.testing.assert_close(
        (start.C[half:] @ arm[:, :, None])[..., 0], turning - torch.tensor([0, 0, 2.0])
    )
    density = start.density.round()
    assert set(density[:half].tolist()) == {1000.0} and set(density[half:].tolist()) == {500.0, 1500.0}
    with refused(files[-1]):
        load_initial_state(*files, [1000.0])
    with refused(files[-1]):
        load_initial_state(*files, [1000.0, 1000.0], "gaussians")
    write_json(files[-1], {"v0": [0, 1.0, 0], **still})
    start, counts = load_initial_state(*files, [1000.0])
    assert counts == [len(both.x0)] and start.v.unique(dim=0).tolist() == [[0, 1, 0]]
    splats, counts = load_initial_state(*files, [500.0], "gaussians")
    assert counts == [len(both.gaussians)]
    torch.testing.assert_close(splats.x, both.gaussians.means)
    torch.testing.assert_close(splats.mass.sum(), 500.0 * both.vol0.sum())
