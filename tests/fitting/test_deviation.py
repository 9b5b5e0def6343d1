"""The penalty on unvisited states: where it acts, what it measures, and what it does to a training."""

import pytest
import torch

from neuma_lib.config.training import TrainingConfig
from neuma_lib.fitting.deviation import BLUR, FLOOR, REACH, Deviation, sample_unvisited
from neuma_lib.fitting.material import PixelLoss, train_material
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.structured import structured_law
from tests.support.errors import refused
from tests.support.gradients import check_directional_derivatives
from tests.support.grounding_scene import MODEL, ball, observe
from tests.support.training import FRAMES, V0, MemoryCheckpoint, stiff_random_law

pytestmark = pytest.mark.core

HENCKY = {"name": "hencky", "E": 3e5, "nu": 0.3}
PLASTIC = {"elasticity": HENCKY, "plasticity": {"name": "von_mises", "yield_stress": 8e3}}


def stretches(count, size, seed=0):
    """Symmetric deformations (count, 3, 3) whose logarithmic strains are about `size`."""
    generator = torch.Generator().manual_seed(seed)
    A = size / 3 * torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    return torch.linalg.matrix_exp(0.5 * (A + A.mT))


def log_strains(F):
    return torch.linalg.svdvals(F).log()


def structured(spec=PLASTIC):
    law = structured_law(spec, MODEL.dt).to(torch.float64)
    law.attach_adaptor(rank=None)
    return law


def perturbed(law, size=0.1):
    generator = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for p in law.parameters():
            if p.requires_grad:
                p.add_(size * torch.randn(p.shape, generator=generator, dtype=p.dtype))
    return law


def visited_by_all(size=0.05):
    return {name: stretches(200, size) for name in ("elasticity", "plasticity")}


def test_states_are_uniform_in_size_up_to_twice_the_visited_and_the_same_every_time():
    visited = stretches(5000, 0.05)
    largest = REACH * float(log_strains(visited).norm(dim=1).quantile(0.99))
    F, weights = sample_unvisited(visited, 4096, isotropic=True)
    size = log_strains(F).norm(dim=1)
    assert float(size.max()) <= largest * (1 + 1e-6)
    assert torch.allclose(F, F.mT)
    # mean and variance of a uniform variable, within four standard errors
    assert float(size.mean()) == pytest.approx(largest / 2, abs=4 * largest * (1 / 12 / 4096) ** 0.5)
    # volume change and shear mix as in uniform directions: the mean square of the normalised trace is 1 / 3
    share = (log_strains(F).sum(1) / 3**0.5 / size) ** 2
    assert float(share.mean()) == pytest.approx(1 / 3, abs=4 * (4 / 45 / 4096) ** 0.5)
    again = sample_unvisited(visited, 4096, isotropic=True)
    assert torch.equal(F, again[0]) and torch.equal(weights, again[1])


def test_a_state_counts_where_the_video_is_silent():
    visited = stretches(500, 0.05)
    F, weights = sample_unvisited(visited, 512, isotropic=True)
    largest = REACH * float(log_strains(visited).norm(dim=1).quantile(0.99))
    distances = torch.cdist(log_strains(F), log_strains(visited)).amin(1)  # both in descending order
    assert torch.allclose(weights, -torch.expm1(-((distances / (BLUR * largest)) ** 2)), atol=1e-6)
    assert float(weights.min()) < 0.1 and float(weights.max()) > 0.99  # both kinds occur


def test_axes_count_for_a_law_that_is_not_isotropic():
    visited = stretches(500, 0.05)
    turn = torch.linalg.matrix_exp(torch.tensor([[0, -1, 0], [1, 0, -1], [0, 1, 0]], dtype=torch.float64))
    (_, same), (_, turned) = (sample_unvisited(F, 256, True) for F in (visited, turn @ visited @ turn.T))
    assert torch.allclose(same, turned, atol=1e-9)
    (_, same), (_, turned) = (sample_unvisited(F, 256, False) for F in (visited, turn @ visited @ turn.T))
    assert float((same - turned).abs().max()) > 0.5
    # turning the body after it was stretched is no other state of either
    _, moved = sample_unvisited(turn @ visited, 256, False)
    assert torch.allclose(same, moved, atol=1e-9)


def test_a_scaled_stress_gives_the_closed_form():
    """Biases of the last layer alone make n constant, so the stress exp(n) times the base's."""
    law, factor = structured({"elasticity": HENCKY}), 1.2
    deviation = Deviation(law, visited_by_all())
    n = torch.tensor(factor, dtype=torch.float64).log()
    argument = n / 3 / (1 - (n / 3) ** 2).sqrt() * 3  # the bounded activation's inverse
    with torch.no_grad():
        law.elasticity.adaptor.D[2][:2, -1] = argument / law.elasticity.adaptor.scales[2]
    tau = analytic_law({"elasticity": HENCKY}).elasticity(deviation.states["elasticity"])
    squares = tau.square().sum((1, 2))
    expected = deviation.weights["elasticity"] * (factor - 1) ** 2 * squares
    expected = (expected / (squares + FLOOR**2 * squares.mean())).mean()
    value = deviation().detach()
    assert float(value) == pytest.approx(float(expected), rel=1e-9)
    assert float(value) < (factor - 1) ** 2


@pytest.mark.parametrize("make", [structured, stiff_random_law])
def test_it_is_zero_at_the_start_and_differentiable(make):
    law = make()
    deviation = Deviation(law, visited_by_all(), states=64)
    parameters = {name: p for name, p in law.named_parameters() if p.requires_grad}
    assert float(deviation().detach()) == 0.0
    gradients = torch.autograd.grad(deviation(), list(parameters.values()))
    assert all(float(g.abs().max()) == 0 for g in gradients)
    perturbed(law)
    assert float(deviation().detach()) > 0
    generator = torch.Generator().manual_seed(5)
    check_directional_derivatives(deviation, parameters, generator, each=False, rel=1e-5)


def test_a_law_that_cannot_deviate_is_refused():
    with refused("penalty"):
        Deviation(structured_law(PLASTIC, MODEL.dt), visited_by_all())


# ---- in the training


@pytest.fixture(scope="module")
def problem():
    body = ball()
    return body, PixelLoss(body, observe(body, V0, FRAMES))


def train(problem, penalty, **options):
    body, loss = problem
    settings = TrainingConfig(
        iterations=8, lr_elastic=0.02, lr_plastic=0.002, checkpoint_every=3, penalty=penalty
    )
    law = stiff_random_law()
    result = train_material(MODEL, law, body.state(V0), loss, settings, log=lambda _: None, **options)
    return result, law


@pytest.fixture(scope="module")
def trained(problem):
    return {penalty: train(problem, penalty) for penalty in (0.0, 10.0)}


def test_a_weight_keeps_the_law_near_its_prior_where_the_video_is_silent(trained):
    results = {}
    for penalty, (_, law) in trained.items():
        law.set_adaptor_weight(0)
        deviation = Deviation(law, visited_by_all(0.1))
        law.set_adaptor_weight(1)
        results[penalty] = float(deviation().detach())
    assert 0 < results[10.0] < 0.5 * results[0.0]


def test_the_first_loss_is_that_without_penalty(trained):
    assert trained[0.0][0].history.loss[0] == trained[10.0][0].history.loss[0]


def test_a_killed_run_resumes_to_the_same_bits(problem, trained):
    _, whole = trained[10.0]
    keep = MemoryCheckpoint(fail_after=2)
    with pytest.raises(KeyboardInterrupt):
        train(problem, 10.0, checkpoint=keep)
    _, resumed = train(problem, 10.0, checkpoint=keep)
    for name, value in whole.adaptor_state().items():
        assert torch.equal(value, resumed.adaptor_state()[name]), name
