"""Binding: the sparse search against Algorithm 1 written out, and what added particles must not change."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.stats import chi2

from neuma_lib.config.binding import BindingConfig
from neuma_lib.coupling.particle_binding import _Columns, _Ellipsoids, bind, bind_two_pass
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.errors import refused
from tests.support.random_bodies import random_gaussians, random_particles
from tests.support.render_scenes import dense

pytestmark = pytest.mark.core

UNIT_BALL = torch.zeros(1, 3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)[None]
"""Mean and covariance of one Gaussian."""


def algorithm_1(means, covars, particles, confidence=0.95, max_neighbours=None):
    """The paper's double loop, one row at a time, with the released code's limit on the neighbours."""
    threshold = chi2.ppf(confidence, 3)
    B = torch.zeros(len(means), len(particles), dtype=means.dtype)
    for i in range(len(means)):
        d_p = particles - means[i]
        d_m = (d_p * torch.linalg.solve(covars[i], d_p.T).T).sum(1)
        inside = torch.nonzero(d_m <= threshold).flatten()
        if max_neighbours is not None:
            inside = inside[torch.argsort(d_m[inside], stable=True)[:max_neighbours]]
        B[i, inside] = 1.0
        if len(inside):
            B[i] /= B[i].sum()
    return B


@pytest.mark.parametrize("max_neighbours", [None, 1, 10])
@pytest.mark.parametrize("size, anisotropy", [(0.02, 0.3), (0.06, 1.5), (0.3, 0.5)])
def test_matches_the_dense_algorithm(size, anisotropy, max_neighbours):
    means, covars = random_gaussians(150, seed=1, size=size, anisotropy=anisotropy)
    particles = random_particles(700, seed=2)
    sparse = bind(means, covars, particles, BindingConfig(max_neighbours=max_neighbours))
    expected = algorithm_1(means, covars, particles, max_neighbours=max_neighbours)
    torch.testing.assert_close(dense(sparse), expected, rtol=1e-14, atol=0)


def test_needles_far_longer_than_the_particle_spacing_are_exact():
    means, covars = random_gaussians(40, seed=3, size=0.02)
    covars = covars * 0 + torch.diag(torch.tensor([0.25, 2e-3, 1e-3], dtype=torch.float64)) ** 2
    particles = random_particles(4000, seed=4)
    expected = algorithm_1(means, covars, particles, max_neighbours=10)
    torch.testing.assert_close(dense(bind(means, covars, particles)), expected)


def test_confidence_widens_the_ellipsoid():
    means, covars = random_gaussians(80, seed=5)
    particles = random_particles(500, seed=6)
    for confidence in (0.5, 0.99):
        sparse = bind(means, covars, particles, BindingConfig(confidence=confidence, max_neighbours=None))
        torch.testing.assert_close(dense(sparse), algorithm_1(means, covars, particles, confidence))


def test_ties_go_to_the_smaller_index():
    particles = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, 0, 1.0]], dtype=torch.float64)
    binding = bind(*UNIT_BALL, particles, BindingConfig(max_neighbours=2))
    assert binding.indices.tolist() == [0, 1]


@pytest.mark.parametrize("max_neighbours", [None, 1, 5, 10, 27, 40])
@pytest.mark.parametrize(
    "shape", [(9, 9, 9), (30, 20, 1), (1, 30, 20), (20, 1, 30), (1, 1, 50), (50, 1, 1), (1, 1, 1)]
)
def test_lattices_are_bound_as_the_dense_algorithm_binds_them(shape, max_neighbours):
    """Many particles equally far, to the last bit, in any order; bodies without a width, a depth or a height."""
    generator = torch.Generator().manual_seed(23)
    axes = [torch.arange(n, dtype=torch.float64) / 32 for n in shape]
    particles = torch.cartesian_prod(*axes)
    particles = particles[torch.randperm(len(particles), generator=generator)]
    means = particles[torch.randint(len(particles), (40,), generator=generator)]
    means[::4] += 1 / 64
    sizes = 2.0 ** torch.randint(-3, 2, (40, 1, 1), generator=generator) / 32
    covars = sizes**2 * torch.eye(3, dtype=torch.float64)
    sparse = bind(means, covars, particles, BindingConfig(max_neighbours=max_neighbours))
    expected = algorithm_1(means, covars, particles, max_neighbours=max_neighbours)
    torch.testing.assert_close(dense(sparse), expected, rtol=1e-14, atol=0)


@pytest.mark.parametrize("equal_mass", [False, True])
def test_two_passes_leave_no_gaussian_empty_and_rows_sum_to_one(equal_mass):
    means, covars = random_gaussians(300, seed=7, size=0.01)
    particles = random_particles(500, seed=8)
    first = bind(means, covars, particles)
    binding, enlarged, added, volumes = bind_two_pass(
        means, covars, particles, 0.1, BindingConfig(equal_mass=equal_mass)
    )
    assert added == int((first.counts == 0).sum()) > 0
    assert binding.shape == (300, 500 + added) and enlarged.shape == (500 + added, 3)
    torch.testing.assert_close(enlarged[500:], means[first.counts == 0])
    assert (binding.counts > 0).all()
    single = bind(means, covars, enlarged)
    assert torch.equal(binding.indptr, single.indptr) and torch.equal(binding.indices, single.indices)
    torch.testing.assert_close(dense(binding).sum(1), torch.ones(300, dtype=torch.float64))
    torch.testing.assert_close(dense(binding), algorithm_1(means, covars, enlarged, max_neighbours=10))
    assert (volumes > 0).all()
    torch.testing.assert_close(volumes.sum(), torch.tensor(0.1, dtype=torch.float64), rtol=1e-13, atol=0)


@pytest.mark.parametrize("outside", [0.0, 0.15])
@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-13), (torch.float32, 3e-7)])
def test_added_particles_keep_mass_and_centre_of_mass(dtype, tolerance, outside):
    """Also with Gaussians outside the body, as at a fitted surface, and with uneven volumes."""
    means, covars = random_gaussians(1500, seed=9, size=0.006, spread=1 + 2 * outside, dtype=dtype)
    means = means - outside
    particles = random_particles(2000, seed=10, dtype=dtype)
    before = torch.rand(2000, generator=torch.Generator().manual_seed(11), dtype=dtype) + 0.5
    _, enlarged, added, after = bind_two_pass(means, covars, particles, before)
    assert added > 500
    assert after.min() > 0 and (after[:2000] >= 0.49 * before).all()
    before, after, particles, enlarged = (a.double() for a in (before, after, particles, enlarged))
    torch.testing.assert_close(after.sum(), before.sum(), rtol=tolerance, atol=0)
    centre = (before @ particles) / before.sum()
    torch.testing.assert_close((after @ enlarged) / after.sum(), centre, rtol=0, atol=tolerance)


@pytest.mark.parametrize("count", [2, 200], ids=["fewer than its neighbours would be", "many"])
def test_a_particle_off_the_plane_of_its_neighbours_has_a_volume(count):
    """No shares balance it there: the centre of mass stays in the plane's directions, and a rollout takes the body."""
    particles = 0.4 + random_particles(count, seed=22, spread=0.2)
    particles[:, 2] = 0.5
    means = torch.tensor([[0.5, 0.5, 0.53], [0.45, 0.48, 0.42]], dtype=torch.float64)
    covars = 1e-6 * torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    _, enlarged, added, volumes = bind_two_pass(means, covars, particles, 1e-3)
    assert added == 2 and volumes.min() > 0
    torch.testing.assert_close(volumes.sum(), torch.tensor(1e-3, dtype=torch.float64), rtol=1e-13, atol=0)
    if count == 200:
        centre = 1e3 * volumes @ enlarged
        torch.testing.assert_close(centre[:2], particles.mean(0)[:2], rtol=0, atol=1e-13)
    law = analytic_law({"elasticity": {"name": "hencky", "E": 5e4, "nu": 0.3}})
    state = State(enlarged, torch.zeros(3, dtype=torch.float64), 1000 * volumes, volumes)
    path = rollout(MPM(16, 1e-3), law, state, steps=2, frames=(2,), skip_free_flight=False)
    assert torch.isfinite(path.x).all()


def test_equal_mass_is_the_papers():
    means, covars = random_gaussians(200, seed=12, size=0.01)
    _, _, added, volumes = bind_two_pass(
        means, covars, random_particles(300, seed=13), 0.2, BindingConfig(equal_mass=True)
    )
    torch.testing.assert_close(volumes, torch.full_like(volumes, 0.2 / (300 + added)))


def test_same_input_gives_the_same_bytes():
    means, covars = random_gaussians(500, seed=18, size=0.02, dtype=torch.float32)
    particles = random_particles(800, seed=19, dtype=torch.float32)
    runs = [bind_two_pass(means, covars, particles, 0.3) for _ in range(2)]
    for first, second in zip(runs[0], runs[1], strict=True):
        if isinstance(first, torch.Tensor):
            assert torch.equal(first, second)
    assert torch.equal(runs[0][0].indices, runs[1][0].indices)
    assert torch.equal(runs[0][0].values, runs[1][0].values)


def splat_of_a_ball(count, seed=20):
    """Discs and needles of a splat on a sphere: in its surface, with lengths up to hundreds of times the thickness."""
    generator = torch.Generator().manual_seed(seed)
    normal = torch.nn.functional.normalize(
        torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=1
    )
    along = torch.linalg.cross(normal, torch.randn(count, 3, generator=generator, dtype=torch.float64))
    along = torch.nn.functional.normalize(along, dim=1)
    axes = torch.stack([normal, along, torch.linalg.cross(normal, along)], dim=2)
    scales = torch.exp(torch.rand(count, 3, generator=generator, dtype=torch.float64) * 2) * torch.tensor(
        [2e-4, 1e-2, 2e-3]
    )
    return 0.3 * normal, axes @ torch.diag_embed(scales**2) @ axes.transpose(1, 2)


@pytest.mark.parametrize("max_neighbours", [None, 10])
def test_the_flat_gaussians_of_a_splat_are_bound_as_the_dense_algorithm_binds_them(max_neighbours):
    means, covars = splat_of_a_ball(800)
    particles = 0.6 * random_particles(400, seed=21) - 0.3
    settings = BindingConfig(max_neighbours=max_neighbours)
    binding, enlarged, added, _ = bind_two_pass(means, covars, particles, 0.1, settings)
    assert added > 500 and binding.counts.max() > 3
    expected = algorithm_1(means, covars, enlarged, max_neighbours=max_neighbours)
    torch.testing.assert_close(dense(binding), expected, rtol=1e-14, atol=0)


def test_the_search_tests_only_particles_near_each_gaussian():
    """Particles in the boxes of the ellipsoids, enlarged to whole cells; a search by distance alone tests more."""
    means, covars = splat_of_a_ball(20000)
    binding = bind(means, covars, means, BindingConfig(max_neighbours=None))
    ellipsoids = _Ellipsoids.of(means, covars, BindingConfig())
    all_inside = ellipsoids._replace(whitening=torch.zeros_like(covars))
    tested = int(all_inside.counts(_Columns.of(means), None).sum())
    reach = (chi2.ppf(0.95, 3) * torch.linalg.eigvalsh(covars)[:, 2]).sqrt()
    within = cKDTree(means.numpy()).query_ball_point(means.numpy(), reach.numpy(), return_length=True).sum()
    assert len(binding.indices) < tested < 0.5 * within


@pytest.mark.parametrize(
    "change, where",
    [
        (dict(particles=torch.zeros(0, 3)), "binding: particles"),
        (dict(particles=torch.full((5, 3), float("nan"))), "binding: particles"),
        (dict(covars=torch.zeros(4, 3, 3)), "binding: covars"),
        (dict(covars=torch.zeros(3, 3, 3)), "binding: means, covars"),
    ],
)
def test_bad_input_is_named(change, where):
    inputs = dict(means=torch.zeros(4, 3), covars=torch.eye(3).expand(4, 3, 3), particles=torch.ones(5, 3))
    with refused(where):
        bind(**(inputs | change))


def test_volumes_must_fit():
    inputs = (torch.zeros(4, 3), torch.eye(3).expand(4, 3, 3), torch.ones(5, 3))
    with refused("binding: volumes"):
        bind_two_pass(*inputs, torch.ones(4))
    with refused("binding: volumes"):
        bind_two_pass(*inputs, -1.0)


def test_threshold_is_the_papers():
    """chi2 with three degrees of freedom at 95 %: 7.815."""
    edge = np.sqrt(7.8147)
    particles = torch.tensor([[edge - 1e-3, 0, 0], [edge + 1e-3, 0, 0]], dtype=torch.float64)
    binding = bind(*UNIT_BALL, particles)
    assert binding.indices.tolist() == [0]
