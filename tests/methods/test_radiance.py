"""Voxel radiance field: lattice transfers and volume rendering against torch twins, differences and closed forms."""

import math

import pytest
import torch

from neuma_lib.methods.pac_nerf import rendering
from neuma_lib.methods.pac_nerf.lattice import EMPTY, Lattice, from_particles, interpolate
from neuma_lib.methods.pac_nerf.rendering import (
    END_LIGHT,
    INTERVAL,
    MIN_LIGHT,
    NEAR,
    STEP,
    ColourNetwork,
    march,
    render,
    render_in_pieces,
    sum_of_terms,
)
from neuma_lib.splatting.cameras import Cameras, look_at
from tests.support.errors import refused
from tests.support.radiance_scenes import CHANNELS, LATTICE, OPACITY, random, scattered, small_scene

pytestmark = pytest.mark.core


def corners(x):
    """Indices (N, 8, 3) of the nodes about the points, and their weights (N, 8), in differentiable torch."""
    u = (x - torch.tensor(LATTICE.origin, dtype=x.dtype)) / LATTICE.voxel
    base = u.detach().floor().long().clamp(torch.zeros(3).long(), torch.tensor(LATTICE.nodes) - 2)
    offsets = torch.cartesian_prod(*[torch.arange(2)] * 3)
    f = (u - base)[:, None]
    return base[:, None] + offsets, torch.where(offsets == 1, f, 1 - f).prod(-1)


def slow_interpolate(values, x):
    nodes, weights = corners(x)
    return (weights[..., None] * values[tuple(nodes.unbind(-1))]).sum(1)


def slow_from_particles(x, features):
    nodes, weights = corners(x)
    sums = torch.zeros(*LATTICE.nodes, features.shape[1], dtype=x.dtype)
    totals = torch.zeros(LATTICE.nodes, dtype=x.dtype)
    index = tuple(nodes.unbind(-1))
    sums = sums.index_put(index, weights[..., None] * features[:, None], accumulate=True)
    totals = totals.index_put(index, weights, accumulate=True)[..., None]
    return torch.where(totals > 1e-10, sums / totals.clamp(min=1e-10), EMPTY)


def slow_render(values, origins, directions, colours, background):
    """Ray by ray, point by point."""
    low, high = torch.tensor([LATTICE.origin, LATTICE.far], dtype=values.dtype)
    pictures, passed = [], []
    for ray, (o, d) in enumerate(zip(origins, directions, strict=True)):
        one, other = (low - o) / d, (high - o) / d
        first = max(NEAR, float(torch.minimum(one, other).max()))
        last = float(torch.maximum(one, other).min())
        light, transmitted = torch.zeros(3, dtype=values.dtype), torch.ones((), dtype=values.dtype)
        for k in range(max(0, math.floor((last - first) / (STEP * LATTICE.voxel)) + 1)):
            read = slow_interpolate(values, (o + (first + k * STEP * LATTICE.voxel) * d)[None])[0]
            interval = INTERVAL * STEP * LATTICE.voxel / OPACITY.base_voxel
            alpha = 1 - (1 + torch.exp(read[0] + OPACITY.shift)) ** -interval
            if transmitted < END_LIGHT or transmitted * alpha <= MIN_LIGHT:
                continue
            colour = colours(read[None, 1:], directions, torch.tensor([ray]))[0]
            light = light + transmitted * alpha * colour
            transmitted = transmitted * (1 - alpha)
        pictures.append(light + transmitted * torch.tensor(background, dtype=values.dtype))
        passed.append(transmitted)
    return torch.stack(pictures), torch.stack(passed)


def agrees_with_differences(function, argument, bound=1e-7, seed=7):
    """Gradient of a random linear function of the results along a random direction, against central differences."""
    direction = random(*argument.shape, seed=seed) - 0.5
    leaf = argument.clone().requires_grad_()
    weights = [random(*out.shape, seed=k) - 0.5 for k, out in enumerate(function(argument))]

    def loss(value):
        return sum((weight * out).sum() for weight, out in zip(weights, function(value), strict=True))

    exact = (torch.autograd.grad(loss(leaf), leaf)[0] * direction).sum()
    h = 1e-5 * float(argument.abs().max())
    steps = [float(loss(argument + k * h * direction).detach()) for k in (-2, -1, 1, 2)]
    difference = (steps[0] - 8 * steps[1] + 8 * steps[2] - steps[3]) / (12 * h)
    return abs(float(exact) - difference) < bound * abs(difference) + 1e-10


def test_interpolation_is_exact_for_trilinear_functions():
    def function(x):
        a, b, c = x.unbind(-1)
        return torch.stack([1 + 2 * a - b, a * b * c - c, b * c], dim=-1)

    x = scattered(200)
    values = function(LATTICE.points(x))
    assert (interpolate(LATTICE, values, x) - function(x)).abs().max() < 1e-13


def test_interpolation_equals_twin():
    values, x = random(*LATTICE.nodes, CHANNELS).requires_grad_(), scattered(200)
    weights = random(200, CHANNELS, seed=3)
    slow, fast = slow_interpolate(values, x), interpolate(LATTICE, values, x)
    assert (slow - fast).abs().max() < 1e-13
    grads = [torch.autograd.grad((weights * out).sum(), values)[0] for out in (slow, fast)]
    assert (grads[0] - grads[1]).abs().max() < 1e-12


def test_particles_to_nodes_equals_twin():
    x, features = scattered(60).requires_grad_(), random(60, CHANNELS).requires_grad_()
    slow, fast = slow_from_particles(x, features), from_particles(LATTICE, x, features)
    assert (fast == EMPTY).any() and (slow - fast).abs().max() < 1e-12
    weights = random(*fast.shape, seed=3)
    pairs = zip(
        *(torch.autograd.grad((weights * out).sum(), (x, features)) for out in (slow, fast)), strict=True
    )
    for a, b in pairs:
        assert (a - b).abs().max() < 1e-10 * a.abs().max()


@pytest.mark.parametrize("wrt", ["positions", "features"])
def test_gradient_of_particles_to_nodes(wrt):
    x, features = scattered(300), random(300, CHANNELS)

    def transfer(value):
        pair = (value, features) if wrt == "positions" else (x, value)
        return (from_particles(LATTICE, *pair),)

    assert agrees_with_differences(transfer, x if wrt == "positions" else features)


def test_particles_to_nodes_keeps_constants_and_moves_with_the_particles():
    """A mean of equal values is that value; a shift by whole voxels moves the nodes' values with it."""
    x, features = scattered(300), random(300, CHANNELS)
    uniform = from_particles(LATTICE, x, torch.full_like(features, 3.7))
    assert (uniform - 3.7)[uniform != EMPTY].abs().max() < 1e-12
    shift = LATTICE.voxel * torch.tensor([2.0, -3.0, 1.0], dtype=torch.float64)
    origin = torch.tensor(LATTICE.origin, dtype=torch.float64) + shift
    moved = Lattice(tuple(origin.tolist()), LATTICE.voxel, LATTICE.nodes)
    a, b = from_particles(LATTICE, x, features), from_particles(moved, x + shift, features)
    assert (a - b).abs().max() < 1e-9


def test_spanning_lattice_holds_its_points_on_fixed_nodes():
    x = 3 * random(50, 3) - 1.5
    lattice = Lattice.spanning(x.amin(0), x.amax(0), 0.07)
    low, high = torch.tensor(lattice.origin), torch.tensor(lattice.far)
    assert (x >= low).all() and (x <= high).all()
    ratio = torch.tensor(lattice.origin).double() / 0.07
    assert (ratio - ratio.round()).abs().max() < 1e-5


def test_rendering_equals_twin():
    values, network, origins, directions = small_scene(density=150.0)
    values.requires_grad_()
    leaves = [values, *network.parameters()]
    results = {}
    for name, function in (
        ("slow", lambda: slow_render(values, origins, directions, network, (0.2, 0.9, 0.4))),
        ("fast", lambda: render(LATTICE, values, OPACITY, network, origins, directions, (0.2, 0.9, 0.4))),
    ):
        outs = function()
        weights = [random(*out.shape, seed=k) for k, out in enumerate(outs)]
        loss = sum((w * out).sum() for w, out in zip(weights, outs, strict=True))
        results[name] = [out.detach() for out in outs], torch.autograd.grad(loss, leaves)
    passed = results["fast"][0][1]
    # rays that miss the lattice, that pass it, and that end early
    assert (passed == 1).any() and (passed > 0.5).any() and (passed < END_LIGHT).any()
    for a, b in zip(*(result[0] for result in results.values()), strict=True):
        assert (a - b).abs().max() < 1e-12
    for a, b in zip(*(result[1] for result in results.values()), strict=True):
        assert (a - b).abs().max() < 1e-10 * a.abs().max()


def test_opaque_points_end_a_ray():
    """A wall hides what is behind it, and nothing behind it is computed."""
    values, network, origins, directions = small_scene()
    values[..., 0] = 2000.0
    points, rays, starts = march(LATTICE, values[..., 0], OPACITY, origins, directions)
    assert ((starts[1:] - starts[:-1]) <= 1).all() and len(points) == len(rays) > 0


@pytest.mark.parametrize("most", [1, 40, 10**9])
def test_pieces_are_the_whole(most, monkeypatch):
    """All rays in their order, no more points at once than allowed unless one ray has them; one piece is `render`."""
    monkeypatch.setitem(rendering.POINTS_AT_ONCE, "cpu", most)
    values, network, *rays = small_scene()
    scene = LATTICE, values, OPACITY, network, *rays, (0.2, 0.9, 0.4)
    starts = march(LATTICE, values[..., 0], OPACITY, *rays)[2].tolist()
    with torch.no_grad():
        whole, pieces = render(*scene), list(render_in_pieces(*scene))
    bounds = [(part.start, part.stop) for part, *_ in pieces]
    assert bounds[0][0] == 0 and bounds[-1][1] == len(rays[0])
    assert all(before[1] == after[0] for before, after in zip(bounds, bounds[1:], strict=False))
    costs = [starts[last] - starts[first] + last - first for first, last in bounds]
    assert all(cost <= most or last == first + 1 for cost, (first, last) in zip(costs, bounds, strict=True))
    assert all(a + b > most for a, b in zip(costs, costs[1:], strict=False)), "no more pieces than it takes"
    assert len(pieces) == {1: len(rays[0]), 40: len(pieces), 10**9: 1}[most]
    for k, out in enumerate(whole, start=1):
        assert (torch.cat([piece[k] for piece in pieces]) - out).abs().max() < 1e-14
        assert most < 10**9 or torch.equal(pieces[0][k], out)


@pytest.mark.parametrize("most", [1, 40, 10**9])
def test_gradient_of_pieces_is_that_of_the_whole(most, monkeypatch):
    """To round-off; to the bit where one piece holds all rays."""
    monkeypatch.setitem(rendering.POINTS_AT_ONCE, "cpu", most)
    values, network, *rays = small_scene()
    network.requires_grad_(False)
    values.requires_grad_()

    def terms(leaf):
        for _, colours, _ in render_in_pieces(LATTICE, leaf, OPACITY, network, *rays):
            yield colours.square().sum()

    for factor in (1.0, 3.0):
        loss = sum_of_terms(terms, values)
        expected = render(LATTICE, values, OPACITY, network, *rays)[0].square().sum()
        (result,), (whole,) = (torch.autograd.grad(factor * value, values) for value in (loss, expected))
        assert float(loss.detach()) == pytest.approx(float(expected.detach()), rel=1e-14)
        assert (result - whole).abs().max() < 1e-13 * whole.abs().max()
        assert most < 10**9 or factor != 1 or (loss == expected and torch.equal(result, whole))
    assert not sum_of_terms(terms, values.detach()).requires_grad


@pytest.mark.parametrize("channels", [slice(0, 1), slice(1, CHANNELS)], ids=["density", "features"])
def test_gradient_of_rendering(channels):
    """With densities at which no ray ends early: there it is smooth."""
    values, network, origins, directions = small_scene()
    values[..., 0] = values[..., 0].abs()

    def picture(part):
        whole = values.clone()
        whole[..., channels] = part
        return render(LATTICE, whole, OPACITY, network, origins, directions)

    _, passed = picture(values[..., channels])
    assert passed.min() > 2 * END_LIGHT
    assert agrees_with_differences(picture, values[..., channels].clone())


def test_uniform_slab_closed_form():
    """Transmittance of a uniform density is (1 + exp(d + b))^(-interval n) after n points."""
    network = ColourNetwork(1, width=4).double()
    values = torch.full((*LATTICE.nodes, 2), 1.5, dtype=torch.float64)
    origins = torch.tensor([[0.25, -0.08, -1.0]], dtype=torch.float64)
    directions = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    passed = float(render(LATTICE, values, OPACITY, network, origins, directions)[1].detach())
    interval = INTERVAL * STEP * LATTICE.voxel / OPACITY.base_voxel
    points = [((LATTICE.nodes[2] - 1) / STEP + k) for k in (0, 1)]  # the last one by round-off
    expected = [(1 + math.exp(1.5 + OPACITY.shift)) ** (-interval * n) for n in points]
    assert min(abs(passed - value) for value in expected) < 1e-12


def test_opacity_of_zero_density_is_the_initial_one():
    assert abs(float(OPACITY(torch.zeros(1, dtype=torch.float64), 1.0)) - OPACITY.initial) < 1e-12


def test_single_precision_agrees():
    values, network, origins, directions = small_scene()
    precise = render(LATTICE, values, OPACITY, network, origins, directions)[0]
    single = render(LATTICE, values.float(), OPACITY, network.float(), origins.float(), directions.float())[0]
    assert (single - precise).abs().mean() < 1e-5


def test_rays_hit_the_pixels_that_points_project_to():
    _, _, origins, directions = small_scene()
    middle = (torch.tensor(LATTICE.origin) + torch.tensor(LATTICE.far)).double() / 2
    viewmats = look_at(origins[:1], middle, torch.tensor([0.0, 1.0, 0.1], dtype=torch.float64))
    K = torch.tensor([[[9.0, 0, 4.1], [0, 9.0, 3.2], [0, 0, 1]]], dtype=torch.float64)
    pixels, _ = Cameras(viewmats, K, 8, 7).project(origins[:56] + 0.7 * directions[:56])
    y, x = torch.meshgrid(torch.arange(7) + 0.5, torch.arange(8) + 0.5, indexing="ij")
    assert (pixels[0] - torch.stack([x, y], dim=-1).reshape(-1, 2)).abs().max() < 1e-10


def test_bad_shapes_are_named():
    x = scattered(4)
    with refused("values"):
        interpolate(LATTICE, random(3, 3, 3, 2), x)
    with refused("features"):
        from_particles(LATTICE, x, random(5, 2))
    with refused("lattice"):
        Lattice((0, 0, 0), 0.1, (1, 4, 4))
