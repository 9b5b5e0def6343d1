"""The total deformation along a rollout, and training with covariances that follow it."""

import pytest
import torch

from neuma_lib.config.training import TrainingConfig
from neuma_lib.errors import InputError
from neuma_lib.evaluation import motion
from neuma_lib.fitting.material import PixelLoss, train_material
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.methods.model import LawOnGrid
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.grounding_scene import MODEL, ball, observe
from tests.support.sim_scenes import cube, spinning

pytestmark = pytest.mark.core

FRAMES = (0, 30, 60)
V0 = torch.tensor([0.0, -1.5, 0.0], dtype=torch.float64)
ELASTIC = {"elasticity": {"name": "hencky", "E": 3e4, "nu": 0.3}}
PLASTIC = {**ELASTIC, "plasticity": {"name": "von_mises", "yield_stress": 50.0}}
EYE = torch.eye(3, dtype=torch.float64)


@pytest.fixture(scope="module")
def body():
    return ball()


def run(body, spec, frames=FRAMES, **options):
    options = {"total": True, **options}
    return rollout(MODEL, analytic_law(spec), body.state(V0), steps=frames[-1], frames=frames, **options)


def product_of_increments(path):
    """The product of I + dt C over all steps, at each of them, from a path that holds them all."""
    actual = [EYE.expand_as(path.C[0])]
    for C in path.C[1:]:
        actual.append((EYE + MODEL.dt * C) @ actual[-1])
    return torch.stack(actual)


def test_is_none_by_default(body):
    path = run(body, ELASTIC, total=False)
    assert path.F_total is None and torch.equal(path.stretch, path.F)


def test_is_the_product_of_the_increments(body):
    every = run(body, PLASTIC, range(FRAMES[-1] + 1))
    expected = product_of_increments(every)
    assert (every.F_total - expected).abs().max() < 1e-12 * expected.abs().max()
    path = run(body, PLASTIC)
    assert torch.equal(path.F_total, every.F_total[list(FRAMES)]) and path.stretch is path.F_total


def test_equals_the_elastic_deformation_without_flow(body):
    path = run(body, ELASTIC)
    assert (path.F_total[-1] - EYE).abs().max() > 1e-3
    assert torch.allclose(path.F_total, path.F, atol=1e-12)


def test_includes_plastic_deformation(body):
    path = run(body, PLASTIC)
    # The return map of von Mises keeps volume, so both have the same determinant but not the same shape.
    assert torch.allclose(torch.linalg.det(path.F_total), torch.linalg.det(path.F), rtol=1e-8)
    spread = [torch.linalg.svdvals(F[-1]).log().std(1).max() for F in (path.F, path.F_total)]
    assert spread[1] > 3 * spread[0]


def test_is_exact_over_a_skipped_free_flight(body):
    frames = (0, 10, 30, 60)
    skipped, simulated = (run(body, PLASTIC, frames, skip_free_flight=skip) for skip in (True, False))
    assert torch.equal(skipped.F_total[1], EYE.expand_as(skipped.F[1]))  # in flight, from closed form
    assert (skipped.F_total - simulated.F_total).abs().max() < 1e-10


def test_rotates_with_a_spinning_body_in_flight():
    """Affine motions are exact in APIC: each step multiplies by I + dt C, with C that follows the motion."""
    x, mass, vol0 = cube(200)
    v, C = spinning(x)
    state = State(x, v, mass, vol0, C=C)
    path = rollout(MODEL, analytic_law(ELASTIC), state, steps=50, frames=range(51), total=True)
    expected = product_of_increments(path)
    assert (path.F_total[-1] - EYE).abs().max() > 0.3
    assert (path.F_total - expected).abs().max() < 1e-12


def test_starts_from_the_deformation_of_the_start(body):
    """A body that is strained already has not flowed before: its total deformation is the elastic one."""
    strained = body.state(V0)
    F = torch.diag(torch.tensor([1.05, 1.0, 0.96], dtype=torch.float64)).expand_as(strained.F)
    state = State(strained.x, strained.v, strained.mass, strained.vol0, F=F)
    path = rollout(MODEL, analytic_law(ELASTIC), state, steps=20, frames=(0, 20), total=True)
    assert torch.equal(path.F_total[0], F) and torch.allclose(path.F_total, path.F, atol=1e-12)


def test_evaluation_carries_it(body):
    """Same states and metrics as without it, and the total deformation of a separate rollout, to the bit."""
    law = analytic_law(PLASTIC)
    tracers = body.x0[:20]
    truth = tracers.expand(len(FRAMES), -1, -1)
    elastic = motion.evaluate(MODEL, LawOnGrid(law), body.state(V0), FRAMES, truth, truth, tracers)
    total = motion.evaluate(MODEL, LawOnGrid(law), body.state(V0), FRAMES, truth, truth, tracers, total=True)
    assert elastic.path.F_total is None
    assert total.metrics == elastic.metrics and torch.equal(total.tracers, elastic.tracers)
    assert total.path.frames == FRAMES and torch.equal(total.path.F, elastic.path.F)
    assert torch.equal(total.path.F_total, run(body, PLASTIC).F_total)


def test_frames_of_a_rollout_that_stopped_early(body):
    held = run(body, PLASTIC).hold_last(2)
    wanted = held.at((0, 60, 90, 120))
    assert wanted.frames == (0, 60, 60, 60)
    for name in ("x", "F_total"):
        assert torch.equal(getattr(wanted, name), getattr(held, name)[[0, 2, 2, 2]])
    with pytest.raises(InputError, match="frames"):
        held.at((0, 31))


def learning_law():
    law = neural_law(seed=5).to(torch.float64)
    with torch.no_grad():
        law.elasticity.base[2].mul_(3e4 / max(law.longitudinal_modulus(), 1.0))
    law.attach_adaptor(rank=4, seed=1)
    return law


def trained(body, iterations=3, total=False, **options):
    loss = PixelLoss(body, observe(body, V0, FRAMES), total=total)
    settings = TrainingConfig(iterations=iterations, **options)
    return train_material(MODEL, learning_law(), body.state(V0), loss, settings, log=lambda _: None)


def test_training_with_the_total_deformation_learns(body):
    result = trained(body, iterations=6, total=True)
    assert result.best_loss < 0.9 * result.history.loss[0]
    assert result.history.loss != trained(body, iterations=6).history.loss


def test_gradients_that_are_not_zeroed_add_up(body):
    still = {"gradient_clip": 1e9, "lr_elastic": 0.0, "lr_plastic": 0.0, "frame_weight_start": 1.0}
    norms = trained(body, zero_gradients=False, **still).history.gradient_norm_elastic
    assert norms == pytest.approx([norms[0], 2 * norms[0], 3 * norms[0]])
    norms = trained(body, zero_gradients=True, **still).history.gradient_norm_elastic
    assert norms == pytest.approx([norms[0]] * 3)
