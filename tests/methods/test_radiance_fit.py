"""Fit of a voxel radiance field: quality through particles, what these weigh, refinement, resuming, bad input."""

import math
from dataclasses import asdict

import pytest
import torch

from neuma_lib.errors import InputError
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.io.weights import write_weights
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.methods.pac_nerf.field import RadianceField
from neuma_lib.methods.pac_nerf.field_fit import fit_radiance_field
from neuma_lib.methods.pac_nerf.field_options import RadianceConfig
from neuma_lib.methods.pac_nerf.io import load_field, save_field
from neuma_lib.methods.pac_nerf.lattice import Lattice, interpolate
from neuma_lib.methods.pac_nerf.rendering import END_LIGHT, ColourNetwork, Opacity, camera_rays
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from neuma_lib.splatting.cameras import Cameras, look_at
from tests.support import raycast
from tests.support.errors import refused

SIZE = 64
SMALL = RadianceConfig(iterations=300, rays=512, particles=2000, rate_density=2.0, held_out=8)
SHORT = SMALL.model_copy(update=dict(iterations=24, rays=64, halvings=(0.5,), checkpoint_every=5))


@pytest.fixture(scope="module")
def duck():
    cameras = raycast.sphere_cameras(24, SIZE)
    return raycast.render(cameras, samples=2), cameras


@pytest.fixture(scope="module")
def fit(duck):
    return fit_radiance_field(*duck, SMALL, seed=3)


def ball(radius=0.3, voxel=0.04, inside=30.0):
    """A field that is opaque in a ball about (0.5, 0.5, 0.5), and clear outside."""
    field = RadianceField(Lattice((0.0, 0.0, 0.0), voxel, (26, 26, 26)), Opacity(1e-4, 0.16)).double()
    points = field.lattice.points(field.density)
    within = (points - 0.5).norm(dim=-1, keepdim=True) < radius
    field.density.data = torch.where(within, inside, -30.0).double()
    return field.requires_grad_(False)


def test_held_out_views_are_reproduced(fit):
    _, report = fit
    assert report.held_out == [4, 12, 20] and len(report.losses) == SMALL.iterations
    assert report.psnr > 24 and report.psnr_object > 19
    assert sum(report.losses[-30:]) < 0.3 * sum(report.losses[:30])


def test_particles_and_back_lose_at_most_one_decibel(fit):
    """It is trained through them."""
    _, report = fit
    assert report.psnr_object > report.direct_psnr_object - 1
    assert report.psnr > report.direct_psnr - 1


@pytest.mark.parametrize("wrt", ["log10 E", "velocity"])
def test_gradient_from_a_picture_through_motion_to_the_law(wrt):
    """What later stages descend on: a bounce on the floor, rendered, against central differences.

    A node that gets its first particle jumps; the step of 1e-6 is far too small for that to happen here.
    """
    torch.manual_seed(0)
    field = ball(radius=0.12, voxel=0.04, inside=20.0)
    field.features.data = torch.randn_like(field.features)
    particles = field.particles(1.0, 1e-3)
    x0 = particles.x - torch.tensor([0.0, 0.33, 0.0]).double()
    camera = Cameras(
        look_at(torch.tensor([[0.5, 0.4, 1.4]]), torch.tensor([0.5, 0.15, 0.5]), torch.tensor([0.0, 1.0, 0.0])),
        torch.tensor([[[24.0, 0, 8.0], [0, 24.0, 7.0], [0, 0, 1]]]), 16, 14,
    ).to(dtype=torch.float64)  # fmt: skip
    start = torch.tensor([5.0] if wrt == "log10 E" else [0.2, -2.0, 0.1]).double()
    direction = torch.ones_like(start)

    def picture(value):
        E, v = (10**value, torch.tensor([0.2, -2.0, 0.1]).double()) if wrt == "log10 E" else (1e5, value)
        law = analytic_law({"elasticity": {"name": "neo_hookean", "E": E, "nu": 0.3}})
        state = State(x0, v, particles.masses(1000.0), particles.volumes())
        path = rollout(MPM(grid=16, dt=1e-3), law, state, steps=60, frames=[60])
        colours, passed = field.render(*particles.seen(path.x[0]), *camera_rays(camera, 0))
        assert passed.min() > 2 * END_LIGHT  # no ray ends early, where the picture has small steps
        weights = torch.linspace(-1, 1, colours.numel()).double().view_as(colours)
        return (weights * colours).sum()

    leaf = start.clone().requires_grad_()
    exact = float(torch.autograd.grad(picture(leaf), leaf)[0] @ direction)
    h = 1e-6
    difference = float(picture(start + h * direction) - picture(start - h * direction)) / (2 * h)
    assert abs(exact) > 1e-3 and abs(exact - difference) < 1e-5 * abs(difference)


@pytest.mark.slow
def test_default_settings_reach_25_decibels_inside_the_object():
    """On a finely textured body, as large and as near as those of the benchmark."""
    cameras = raycast.sphere_cameras(50, 128)
    _, report = fit_radiance_field(raycast.render(cameras, samples=2), cameras, RadianceConfig())
    assert report.psnr_object > 25 and report.psnr > 25
    assert report.psnr_object > report.direct_psnr_object - 1


def test_particles_lie_in_the_body(fit):
    field, report = fit
    particles = field.particles(SMALL.spacing, SMALL.min_opacity)
    assert report.particles == len(particles.x)
    assert (raycast.distance(particles.x) < 1.5 * report.voxel).double().mean() > 0.95
    # nearly all of the body is filled
    cells = torch.cartesian_prod(*[torch.arange(0.1, 0.9, 0.02)] * 3)
    inner = cells[raycast.distance(cells) < -report.voxel]
    assert (torch.cdist(inner, particles.x).amin(1) < report.voxel).double().mean() > 0.95


def test_weights_of_particles():
    """An opaque ball has the mass and volume of the ball; a fuzzy particle weighs alpha and is stiff by alpha^3."""
    radius, voxel = 0.3, 0.04
    particles = ball(radius, voxel).particles(0.5, 1e-3)
    body = 4 / 3 * math.pi * radius**3
    shell = 4 * math.pi * radius**2 * voxel  # opacity falls from 1 to 0 over a voxel
    assert abs(float(particles.masses(1200.0).sum()) - 1200 * body) < 1200 * shell / 2
    opaque = particles.opacities > 1 - 1e-9
    assert opaque.any() and (particles.volumes()[opaque] - (voxel / 2) ** 3).abs().max() < 1e-12
    ratio = particles.volumes() / (particles.masses(1200.0) / 1200)
    assert torch.allclose(ratio, particles.opacities**2)
    assert (particles.opacities >= 1e-3 * particles.opacities.max()).all()


def test_particles_are_the_same_every_time_and_new_with_a_generator():
    field = ball()
    a, b = (field.particles(0.5, 1e-3) for _ in range(2))
    assert torch.equal(a.x, b.x)
    other = field.particles(0.5, 1e-3, torch.Generator().manual_seed(5))
    assert not torch.equal(a.x[:10], other.x[:10])


@pytest.mark.parametrize("spacing, per_voxel", [(0.5, 8), (0.8, 1 / 0.8**3)])
def test_number_of_particles(spacing, per_voxel):
    field = RadianceField(Lattice((0.0, 0.0, 0.0), 0.1, (9, 9, 9)), Opacity(1e-4, 0.16))
    particles = field.particles(spacing, 1e-3)  # all alike, so all are kept
    assert len(particles.x) == pytest.approx(per_voxel * 8**3)
    assert particles.x.min() >= 0 and particles.x.max() <= 0.8 + 1e-6


def test_halving_keeps_the_field_and_leaves_out_what_is_empty():
    field = ball()
    torch.manual_seed(0)
    field.features.data = torch.rand_like(field.features)
    refined = field.halved()
    assert refined.lattice.voxel == field.lattice.voxel / 2
    low, high = torch.tensor(refined.lattice.origin), torch.tensor(refined.lattice.far)
    # what a particle may lie in: nodes in the ball reach 0.24 to 0.76, and their cells a voxel further
    assert (low - 0.2).abs().max() < 1e-6 and (high - 0.8).abs().max() < 1e-6
    points = low + (high - low) * torch.rand(500, 3)
    coarse, fine = (interpolate(f.lattice, f.values(), points.double()) for f in (field, refined))
    assert (coarse - fine).abs().max() < 1e-9  # trilinear interpolation of itself


def test_resumes_bit_for_bit(duck, tmp_path):
    """Killed after the voxel was halved, and resumed."""
    whole, report = fit_radiance_field(*duck, SHORT, seed=1)

    def kill(iteration, loss):
        if iteration == 17:
            raise KeyboardInterrupt

    state = tmp_path / "state.pt"
    with pytest.raises(KeyboardInterrupt):
        fit_radiance_field(*duck, SHORT, seed=1, checkpoint=Checkpoint(state, {}), progress=kill)
    seen = []
    resumed, again = fit_radiance_field(
        *duck, SHORT, seed=1, checkpoint=Checkpoint(state, {}), progress=lambda i, _: seen.append(i)
    )
    assert seen == list(range(15, 24)) and again.losses == report.losses
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name])


def test_file_round_trip(tmp_path, fit, duck):
    field, _ = fit
    path = tmp_path / "field.safetensors"
    save_field(path, field, {"seed": 3})
    loaded, metadata = load_field(path)
    assert metadata["seed"] == 3 and loaded.lattice == field.lattice
    assert torch.equal(loaded.draw(duck[1], 4), field.draw(duck[1], 4))
    assert not any(value.requires_grad for value in loaded.parameters()), "it is not trained"


def test_foreign_file_is_named(tmp_path):
    path = tmp_path / "other.safetensors"
    write_weights(path, {"weight": torch.zeros(3)}, {})
    with refused("other.safetensors"):
        load_field(path)


@pytest.mark.parametrize("nodes", [(400, 400, 400), (10**6,) * 3, (26, 26, 25)])
def test_a_file_that_claims_other_nodes_than_it_has_is_refused_before_they_are_allocated(
    tmp_path, monkeypatch, nodes
):
    field, path = ball(), tmp_path / "claims.safetensors"
    claimed = {"lattice": {**asdict(field.lattice), "nodes": nodes}, "opacity": asdict(field.opacity)}
    write_weights(path, field.state_dict(), claimed)
    monkeypatch.setattr(RadianceField, "__init__", None)
    with refused(path, problem="densities of shape (26, 26, 26, 1)"):
        load_field(path)


def test_a_lattice_of_too_many_nodes_is_refused_before_it_is_allocated():
    with refused("lattice", problem="nodes exceed", remedy="radiance.voxel"):
        RadianceField(Lattice((0.0, 0.0, 0.0), 1e-3, (1000, 1000, 1000)), Opacity(1e-4, 1e-3))


def test_bad_input_is_named(duck):
    images, cameras = duck
    with refused("images"):
        fit_radiance_field(images[:5], cameras, SHORT)
    images = images.clone()
    images[7, ..., 3] = 0
    with pytest.raises(InputError, match="view 7"):
        fit_radiance_field(images, cameras, SHORT)
    with refused("radiance.held_out"):
        fit_radiance_field(images[:1], cameras[:1], SHORT)
    with pytest.raises(ValueError, match="halvings"):
        RadianceConfig(halvings=(0.5, 0.2))


def test_network_sees_the_direction():
    torch.manual_seed(0)
    network = ColourNetwork()
    features = torch.rand(1, 12).expand(2, 12)
    directions = torch.eye(3)[:2]
    colours = network(features, directions, torch.tensor([0, 1]))
    assert (colours[0] - colours[1]).abs().max() > 1e-4 and ((colours > 0) & (colours < 1)).all()
