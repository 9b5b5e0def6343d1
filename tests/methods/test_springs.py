"""Networks of springs: forces and gradients against a slow twin, closed forms, energy, momentum, what follows them."""

import math

import pytest
import torch

from neuma_lib.coupling.interpolation import Interpolation
from neuma_lib.errors import NonFiniteError
from neuma_lib.methods.spring_gaus.network import SpringNetwork, Springs, farthest_points
from neuma_lib.methods.spring_gaus.rollout import MAX_SUBSTEPS, SpringModel, spring_rollout
from tests.support.errors import refused
from tests.support.gradients import check_directional_derivatives

pytestmark = pytest.mark.core

FREE = (0.0, 0.0, 0.0)
G = (0.0, -9.8, 0.0)


def cloud(count, seed=0, size=0.2, centre=0.5, dtype=torch.float64):
    g = torch.Generator().manual_seed(seed)
    return (centre + size * (torch.rand(count, 3, generator=g, dtype=torch.float64) - 0.5)).to(dtype)


def springs_of(
    count=14, neighbours=8, hard=3, k=60.0, damping=0.1, exponent=0.5, dtype=torch.float64, spread=0.2
):
    """A small random network with stiffnesses that differ."""
    network = SpringNetwork.of(cloud(count, dtype=dtype), neighbours, hard, exponent)
    springs = Springs(network, k, damping, gap=4e-3)
    with torch.no_grad():
        springs.log_stiffness += spread * torch.randn(count, generator=torch.Generator().manual_seed(1)).to(
            dtype
        )
        springs.softness += 0.3
    return springs


def twin(model, springs, x, v, frames):
    """The same in plain torch, substep by substep."""
    stiffness, eta, damping, friction, gap = springs.values()
    network, dt = springs.network, model.dt / model.substeps
    near, rest = network.neighbours.long(), network.rest
    results = []
    for step in range(frames[-1] * model.substeps + 1):
        if step in [n * model.substeps for n in frames]:
            results.append((x, v))
        d = x[near] - x[:, None]
        length = d.norm(dim=-1)
        n = d / length[..., None]
        stretch = torch.where((length - rest).abs() < 1e-6, 0.0, length - rest)
        pull = eta * stiffness[:, None] / rest * stretch * (1 + (length / rest - 1).abs()) ** network.exponent
        drag = damping / rest * ((v[near] - v[:, None]) * n).sum(-1)
        v = v + dt * (((pull + drag)[..., None] * n).sum(1) + torch.tensor(model.gravity, dtype=x.dtype))
        x = x + dt * v
        hit = (x <= model.low + gap) | (x >= model.high - gap)
        v = torch.where(hit, 0.0, v * friction ** hit.sum(1, keepdim=True))
        x = torch.where(hit, torch.minimum(torch.maximum(x, model.low + gap), model.high - gap), x)
    return tuple(torch.stack(part) for part in zip(*results, strict=True))


def falling(dtype=torch.float64, exponent=0.5):
    """Fourteen anchors that hit the ground and a side wall obliquely."""
    springs = springs_of(dtype=dtype, exponent=exponent)
    x0 = springs.network.anchors + torch.tensor([-0.38, -0.38, 0.0], dtype=dtype)
    x0 = x0 + 0.01 * torch.randn(
        x0.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64
    ).to(dtype)
    v0 = torch.tensor([-1.0, -1.5, 0.4], dtype=dtype) + torch.zeros_like(x0)
    return SpringModel(5e-3, G, 0.0, 1.0, 2), springs, x0, v0


@pytest.mark.parametrize("exponent", [0.5, 1.3])
def test_kernel_agrees_with_its_twin(exponent):
    model, springs, x0, v0 = falling(exponent=exponent)
    with torch.no_grad():
        x, v, used = spring_rollout(model, springs, x0, v0, (0, 3, 12))
        x_twin, v_twin = twin(used, springs, x0, v0, (0, 3, 12))
    assert used == model
    assert (x[-1] <= 4e-3).any(0)[:2].all()  # both walls were met
    assert (x - x_twin).abs().max() < 1e-12 and (v - v_twin).abs().max() < 1e-10


def test_single_precision_agrees_with_double():
    ends = []
    for dtype in (torch.float64, torch.float32):
        with torch.no_grad():
            x, *_ = spring_rollout(*falling(dtype), (0, 10))
        ends.append(x[-1].double())
    assert (ends[0] - ends[1]).abs().max() < 1e-5


@pytest.mark.parametrize("exponent", [0.5, 1.3])
def test_gradients_agree_with_differences(exponent):
    """Of start, stiffness, soft vector, damping, friction and gap; contacts at two walls, two frames in the loss."""
    model, springs, x0, v0 = falling(exponent=exponent)
    x0, v0 = x0.requires_grad_(), v0.requires_grad_()
    generator = torch.Generator().manual_seed(3)
    weights = torch.randn(2, 2, *x0.shape, generator=generator, dtype=torch.float64)

    def value():
        x, v, _ = spring_rollout(model, springs, x0, v0, (5, 11))
        return (weights[0] * x).sum() + 0.1 * (weights[1] * v).sum()

    inputs = {"x": x0, "v": v0, **dict(springs.named_parameters())}
    check_directional_derivatives(value, inputs, generator, floor=1e-3, rel=2e-6, abs=1e-8)


def test_gradient_of_a_part_of_the_video_sees_only_its_own_steps():
    """From a state in flight on, the substeps are those of the whole."""
    model, springs, x0, v0 = falling()
    with torch.no_grad():
        x, v, _ = spring_rollout(model, springs, x0, v0, (4, 10))
        again, *_ = spring_rollout(model, springs, x[0], v[0], (10,), first=4)
    assert torch.equal(again[0], x[1])


def test_bodies_at_rest_fall_freely_and_keep_their_shape():
    springs = springs_of()
    x0, v0 = springs.network.anchors, torch.tensor([0.3, 0.2, -0.1], dtype=torch.float64)
    model, n = SpringModel(1e-3, G, 0.0, 1.0), 150
    with torch.no_grad():
        x, v, used = spring_rollout(model, springs, x0, v0.expand_as(x0), (n,))
    dt, steps = model.dt / used.substeps, n * used.substeps
    gravity = torch.tensor(G, dtype=torch.float64)
    assert (x[0] - (x0 + steps * dt * v0 + dt**2 * steps * (steps + 1) / 2 * gravity)).abs().max() < 1e-12
    assert (v[0] - (v0 + steps * dt * gravity)).abs().max() < 1e-12


def test_frequency_of_one_spring():
    """Two unit masses that both pull: omega^2 = 2 k / l, and a step of phase with sin(phase / 2) = omega dt / 2."""
    rest, k, dt = 0.2, 50.0, 1e-3
    anchors = torch.tensor([[0.4, 0.5, 0.5], [0.4 + rest, 0.5, 0.5]], dtype=torch.float64)
    springs = Springs(SpringNetwork.of(anchors, 1, 1, exponent=0.0), k, 1e-12)
    amplitude, steps = 0.02, 400
    x0 = anchors + torch.tensor([[-amplitude / 2, 0, 0], [amplitude / 2, 0, 0]], dtype=torch.float64)
    with torch.no_grad():
        x, *_ = spring_rollout(
            SpringModel(dt, FREE, 0.0, 1.0), springs, x0, torch.zeros_like(x0), range(steps)
        )
    elongation = (x[:, 1] - x[:, 0])[:, 0] - rest
    phase = 2 * math.asin(math.sqrt(2 * k / rest) * dt / 2)
    n = torch.arange(steps, dtype=torch.float64)
    # e_0 = A and v_0 = 0: e_n = A cos((n + 1/2) phase) / cos(phase / 2). The slack is felt at most at zero crossings.
    expected = amplitude * torch.cos((n + 0.5) * phase) / math.cos(phase / 2)
    assert (elongation - expected).abs().max() < 20e-6


def full_network(damping):
    """All anchors in all lists and one stiffness: each spring pulls both of its ends alike."""
    network = SpringNetwork.of(cloud(12), 11, 11)
    return Springs(network, 80.0, damping)


def energy(springs, x, v):
    """Kinetic energy and, by its closed form for p = 1/2, that of the springs, [m^2/s^2] at unit mass."""
    stiffness, eta, *_ = springs.values()
    rest = springs.network.rest
    strain = (x[:, springs.network.neighbours.long()] - x[:, :, None]).norm(dim=-1) / rest - 1
    u = 1 + strain.abs()
    # k l times the integral of e sqrt(1 + e) from 0 on
    stored = 2 / 5 * u**2.5 - 2 / 3 * u**1.5 + 4 / 15
    return 0.5 * v.square().sum((1, 2)) + 0.5 * (stiffness[:, None] * eta * rest * stored).sum((1, 2))


def strained(springs):
    x0 = springs.network.anchors
    turn = torch.linalg.cross(torch.tensor([0.0, 3.0, 1.0], dtype=x0.dtype).expand_as(x0), x0 - x0.mean(0))
    return 0.5 + (x0 - 0.5) * torch.tensor([1.2, 0.9, 1.0], dtype=x0.dtype), turn


def test_energy_is_kept_without_damping_and_falls_with_it():
    model, frames = SpringModel(1e-3, FREE, 0.0, 1.0, 8), range(0, 100, 2)
    results = {}
    for damping in (1e-12, 0.05):
        springs = full_network(damping)
        with torch.no_grad():
            x, v, _ = spring_rollout(model, springs, *strained(springs), frames)
            results[damping] = energy(springs, x, v)
    kept, falling_energy = results.values()
    assert (kept / kept[0] - 1).abs().max() < 0.01  # of first order in the substep
    assert (falling_energy[1:] < falling_energy[:-1]).all() and falling_energy[-1] < 0.8 * falling_energy[0]


def test_momentum_is_kept_where_lists_are_mutual_and_not_where_they_are_directed():
    """The second is published so: anchors feel only their own lists."""
    model, drift = SpringModel(1e-3, FREE, 0.0, 1.0, 4), {}
    mutual, directed = full_network(0.05), springs_of(12, 5, 5, k=80.0, damping=0.05)
    for name, springs in (("mutual", mutual), ("directed", directed)):
        x0, v0 = strained(springs)
        with torch.no_grad():
            _, v, _ = spring_rollout(model, springs, x0, v0, (0, 50))
        drift[name] = float((v[1].sum(0) - v[0].sum(0)).norm())
    assert drift["mutual"] < 1e-12
    assert drift["directed"] > 0.1


def test_modulus_of_a_network_is_that_of_its_energy():
    """Stretched by a small strain along an axis, a ball stores (lambda + 2 mu) e^2 / 2 = 3 E e^2 / 5 per volume."""
    generator = torch.Generator().manual_seed(4)
    points = torch.randn(3000, 3, generator=generator, dtype=torch.float64)
    radius = 0.2
    points *= (
        radius
        * torch.rand(3000, 1, generator=generator, dtype=torch.float64) ** (1 / 3)
        / points.norm(dim=1, keepdim=True)
    )
    network = SpringNetwork.of(points, 48, 8)
    density, strain = 1000.0, 1e-4
    springs = Springs.of_modulus(network, 2e5, density, 0.1)
    assert springs.modulus(density) == pytest.approx(2e5)
    stiffness, eta, *_ = (value.detach() for value in springs.values())
    results = []
    for axis in range(3):
        x = points.clone()
        x[:, axis] *= 1 + strain
        elongation = (x[network.neighbours.long()] - x[:, None]).norm(dim=-1) - network.rest
        stored = 0.25 * (eta * stiffness[:, None] / network.rest * elongation**2).sum()
        results.append(float(stored * density / len(points) / (0.6 * strain**2)))
    assert sum(results) / 3 == pytest.approx(2e5, rel=0.02) and min(results) > 0.9 * max(results)


def test_springs_of_another_body_have_the_same_modulus():
    springs = springs_of(60, 20, 4)
    network = SpringNetwork.of(cloud(90, seed=7, size=0.3), 20, 4)
    other = springs.for_network(network, 1000.0, 500.0)
    assert other.modulus(500.0) == pytest.approx(springs.modulus(1000.0))
    assert other.shared() == springs.shared() and torch.equal(other.softness, springs.softness)


def test_soft_vector_is_that_of_the_paper():
    network = SpringNetwork.of(cloud(30), 20, 4)
    eta = network.soft_vector(torch.zeros(1, dtype=torch.float64))
    assert (eta[:4] == 1).all()
    expected = 2 - 2 ** (torch.arange(16, dtype=torch.float64) / 16)  # e^softplus(0) = 2
    assert torch.allclose(eta[4:], expected)
    assert (network.rest[:, 1:] >= network.rest[:, :-1]).all()


def test_guard_halves_the_step_and_gives_up_at_its_limit(monkeypatch):
    springs = springs_of(k=3000.0)
    x0, v0 = strained(springs)
    model, messages = SpringModel(1e-2, FREE, 0.0, 1.0), []
    with torch.no_grad():
        *_, safe = spring_rollout(model, springs, x0, v0, (40,), log=messages.append)
    assert safe.substeps > 2 and not messages  # foreseen
    monkeypatch.setattr(SpringNetwork, "stable_step", lambda *_: 1.0)  # a bound that is wrong
    with torch.no_grad():
        x, *_, used = spring_rollout(model, springs, x0, v0, (40,), log=messages.append)
    assert used.substeps in (2, 4, 8, 16) and len(messages) == math.log2(used.substeps)
    assert f"{used.substeps} substeps" in messages[-1] and x.isfinite().all()
    monkeypatch.undo()
    stiff = Springs(springs.network, 1e12, 0.1)
    with pytest.raises(NonFiniteError, match=f"too stiff for {MAX_SUBSTEPS} substeps"):
        spring_rollout(model, stiff, x0, v0, (40,))


def test_a_start_that_runs_away_ends_with_its_anchor_and_step():
    springs = springs_of()
    x0, v0 = strained(springs)
    v0 = v0.clone()
    v0[5, 2] = math.nan
    with pytest.raises(NonFiniteError, match="anchor 5 became non-finite at step 7") as caught:
        spring_rollout(SpringModel(1e-2, FREE, 0.0, 1.0), springs, x0, v0, (9,), first=7)
    assert (caught.value.step, caught.value.particle) == (7, 5)


def test_points_follow_affine_motions_of_their_anchors():
    anchors, points = cloud(200), cloud(500, seed=1, size=0.22)
    follow = Interpolation(points, anchors, 16)
    A = torch.tensor([[0.9, -0.5, 0.1], [0.4, 1.0, 0.2], [0.0, 0.1, 1.2]], dtype=torch.float64)
    b = torch.tensor([0.1, -0.2, 0.3], dtype=torch.float64)
    x, F = follow(torch.stack([anchors, anchors @ A.T + b]))
    assert torch.equal(x[0], points) and (F[0] - torch.eye(3)).abs().max() == 0
    assert (x[1] - points @ A.T - b).abs().max() < 1e-4  # of 0.2 m: FLATNESS over the flattest neighbourhood
    assert (F[1] - A).abs().max() < 2e-3
    assert (follow.velocities((anchors @ A.T)[None])[0] - points @ A.T).abs().max() < 1e-4


def test_no_points_follow_as_none():
    """As of a capture, which has no tracers."""
    anchors = cloud(20)
    positions, gradients = Interpolation(anchors[:0], anchors, 16)(torch.stack([anchors, anchors + 1]))
    assert positions.shape == (2, 0, 3) and gradients.shape == (2, 0, 3, 3)


def test_points_carry_their_gradients_to_the_anchors():
    anchors, points = cloud(40), cloud(9, seed=1)
    follow = Interpolation(points, anchors, 16)
    x = (anchors + 0.01 * torch.randn(2, *anchors.shape, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(follow, x)


def test_farthest_points_cover_the_cloud():
    points = cloud(2000)
    index = farthest_points(points, 100)
    assert len(set(index.tolist())) == 100 and torch.equal(index, index.sort().values)
    gap = torch.cdist(points, points[index]).amin(1).max()
    distance = torch.cdist(points[index], points[index]).fill_diagonal_(1).min()
    assert distance >= gap  # each chosen one was farther from the others than any point is now
    assert torch.equal(farthest_points(points[:5], 9), torch.arange(5))


@pytest.mark.parametrize(
    ("make", "where"),
    [
        (lambda: SpringNetwork.of(cloud(1), 3, 1), "springs.anchors"),
        (lambda: SpringNetwork.of(cloud(4).repeat(2, 1), 3, 1), "springs.anchors"),
        (lambda: Interpolation(cloud(5), cloud(3), 16), "springs"),
    ],
)
def test_bad_input_is_refused(make, where):
    with refused(where):
        make()
