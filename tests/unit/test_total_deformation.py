"""The total deformation along a rollout, and training with covariances that follow it."""

import pytest
import torch
from grounding_scene import MODEL, ball, observe

from neuma_lib.config.material import MaterialConfig
from neuma_lib.errors import InputError
from neuma_lib.evaluation import motion
from neuma_lib.fitting.material import PixelLoss, train_material
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.total_deformation import every_step, total_deformation

FRAMES = (0, 30, 60)
V0 = torch.tensor([0.0, -1.5, 0.0], dtype=torch.float64)
ELASTIC = {"elasticity": {"name": "hencky", "E": 3e4, "nu": 0.3}}
PLASTIC = {**ELASTIC, "plasticity": {"name": "von_mises", "yield_stress": 50.0}}


@pytest.fixture(scope="module")
def body():
    return ball()


def paths(body, spec):
    """The same motion at the frames, and with its total deformation."""

    def run(frames):
        return rollout(MODEL, analytic_law(spec), body.state(V0), steps=FRAMES[-1], frames=frames)

    return run(FRAMES), total_deformation(run(every_step(FRAMES)), MODEL.dt, FRAMES)


def test_equals_the_elastic_one_where_nothing_flows(body):
    elastic, total = paths(body, ELASTIC)
    assert total.frames == FRAMES and torch.equal(total.x, elastic.x)
    assert (total.F[-1] - torch.eye(3, dtype=torch.float64)).abs().max() > 1e-3
    assert torch.allclose(total.F, elastic.F, atol=1e-10)


def test_keeps_what_has_flowed(body):
    elastic, total = paths(body, PLASTIC)
    # The return map of von Mises keeps volume, so both have the same determinant but not the same shape.
    assert torch.allclose(torch.linalg.det(total.F), torch.linalg.det(elastic.F), rtol=1e-8)
    spread = [torch.linalg.svdvals(F[-1]).log().std(1).max() for F in (elastic.F, total.F)]
    assert spread[1] > 3 * spread[0]


def test_needs_every_step(body):
    with pytest.raises(InputError, match="every_step"):
        total_deformation(paths(body, ELASTIC)[0], MODEL.dt, FRAMES)


def test_evaluation_follows_it_in_one_simulation(body, monkeypatch):
    """Same states and metrics as without it, and the total deformation of a rollout of its own, to the bit."""
    law, runs = analytic_law(PLASTIC), []
    monkeypatch.setattr(
        motion, "rollout", lambda *args, **options: runs.append(1) or rollout(*args, **options)
    )
    tracers = body.x0[:20]
    truth = tracers.expand(len(FRAMES), -1, -1)
    elastic = motion.evaluate(MODEL, law, body.state(V0), FRAMES, truth, truth, tracers)
    total = motion.evaluate(MODEL, law, body.state(V0), FRAMES, truth, truth, tracers, total=True)
    assert len(runs) == 2 and elastic.F_total is None
    assert total.metrics == elastic.metrics and torch.equal(total.tracers, elastic.tracers)
    assert total.path.frames == FRAMES and torch.equal(total.path.F, elastic.path.F)
    assert torch.equal(total.F_total, paths(body, PLASTIC)[1].F)


def test_frames_of_a_rollout_that_stopped_early(body):
    held = paths(body, ELASTIC)[0].hold_last(2)
    wanted = held.at((0, 60, 90, 120))
    assert wanted.frames == (0, 60, 60, 60)
    assert torch.equal(wanted.x, held.x[[0, 2, 2, 2]])
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
    settings = MaterialConfig(iterations=iterations, **options)
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
