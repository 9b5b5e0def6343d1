"""The training loop: gradients from the adaptor to the loss, progress, recovery, and resuming."""

import numpy as np
import pytest
import torch

from neuma_lib.config.training import TrainingConfig
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import NonFiniteError
from neuma_lib.fitting.material import ParticleLoss, PixelLoss, frame_weights, train_material
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.errors import refused
from tests.support.gradients import check_directional_derivatives
from tests.support.grounding_scene import MODEL, ball, camera, observe
from tests.support.training import FRAMES, V0, MemoryCheckpoint, stiff_random_law

pytestmark = pytest.mark.core


@pytest.fixture(scope="module")
def problem():
    body = ball()
    return body, PixelLoss(body, observe(body, V0, FRAMES))


def test_gradient_from_adaptor_to_image_loss(problem):
    body, loss = problem
    law = stiff_random_law()
    parameters = {name: p for name, p in law.named_parameters() if p.requires_grad}
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():  # away from B = 0, where A has no gradient
        for p in parameters.values():
            p.add_(0.05 * torch.randn(p.shape, generator=generator, dtype=p.dtype))

    def value():
        path = rollout(MODEL, law, body.state(V0), steps=60, frames=FRAMES)
        return loss(path).mean()

    check_directional_derivatives(value, parameters, generator, each=False, rel=1e-5)


SETTINGS = TrainingConfig(iterations=12, lr_elastic=0.02, lr_plastic=0.002, checkpoint_every=3)


def train(problem, law=None, settings=SETTINGS, **options):
    body, loss = problem
    law = law or stiff_random_law()
    return train_material(MODEL, law, body.state(V0), loss, settings, log=lambda _: None, **options)


@pytest.fixture(scope="module")
def trained(problem):
    return train(problem)


def test_training_lowers_the_loss_and_moves_the_adaptor_only(trained):
    assert trained.stable
    assert trained.best_loss < 0.7 * trained.history.loss[0]
    assert len(trained.history.loss) == len(trained.history.seconds) == SETTINGS.iterations
    for before, after in zip(stiff_random_law().parameters(), trained.law.parameters(), strict=True):
        assert after.requires_grad or torch.equal(before, after)


def video_of(body, v0, frames):
    """Start and loss of another motion, which shows the same material as `observe`."""
    return body.state(v0), PixelLoss(body, observe(body, v0, frames))


def test_the_same_video_twice_trains_as_once(problem, trained):
    again = train(problem, other_videos=[(problem[0].state(V0), problem[1])])
    torch.testing.assert_close(
        torch.tensor(again.history.loss), torch.tensor(trained.history.loss), rtol=1e-9, atol=0
    )
    torch.testing.assert_close(again.law.adaptor_state(), trained.law.adaptor_state(), rtol=1e-6, atol=1e-9)


def test_videos_count_alike_however_long(problem):
    """Loss and gradient of the first iteration are the means of those of the videos, one of which has more frames."""
    once = SETTINGS.model_copy(update={"iterations": 1, "gradient_clip": 1e30})
    other = video_of(problem[0], torch.tensor([0.4, -0.8, 0.1], dtype=torch.float64), tuple(range(0, 55, 6)))
    both = train(problem, settings=once, other_videos=[other])
    alone = [train((problem[0], problem[1]), settings=once)]
    law = stiff_random_law()
    alone.append(train_material(MODEL, law, *other, once, log=lambda _: None))
    first = [run.history.loss[0] for run in alone]
    assert both.history.loss[0] == pytest.approx(sum(first) / 2, rel=1e-12)
    weighted = [run.history.weighted_loss[0] for run in alone]
    assert both.history.weighted_loss[0] == pytest.approx(sum(weighted) / 2, rel=1e-12)
    # The loss is divided by its first value before.
    grads = [
        {key: p.grad * run.history.loss[0] for key, p in run.law.named_parameters() if p.grad is not None}
        for run in (both, *alone)
    ]
    assert grads[0]
    for name, grad in grads[0].items():
        torch.testing.assert_close(grad, (grads[1][name] + grads[2][name]) / 2, rtol=1e-9, atol=1e-18)


def test_one_law_fits_two_videos(problem):
    other = video_of(problem[0], torch.tensor([0.4, -1.1, 0.1], dtype=torch.float64), FRAMES)
    both = train(problem, other_videos=[other])

    def loss_of(law, start, loss):
        with torch.no_grad():
            return float(loss(rollout(MODEL, law, start, steps=FRAMES[-1], frames=FRAMES)).mean())

    for start, loss in ((problem[0].state(V0), problem[1]), other):
        assert loss_of(both.law, start, loss) < 0.8 * loss_of(stiff_random_law(), start, loss)


def test_a_killed_run_resumes_to_the_same_bits(problem, trained):
    whole = trained.law.adaptor_state()
    keep = MemoryCheckpoint(fail_after=2)
    with pytest.raises(KeyboardInterrupt):
        train(problem, checkpoint=keep)
    resumed = train(problem, checkpoint=keep).law.adaptor_state()
    assert len(keep.states) == 4
    for name, value in whole.items():
        assert torch.equal(value, resumed[name]), name


class ScriptedLoss:
    """A loss whose value at the n-th call is multiplied by the n-th factor."""

    def __init__(self, loss, factors):
        self.loss, self.factors = loss, list(factors)
        self.frames, self.steps, self.total = loss.frames, loss.steps, loss.total

    def __call__(self, path):
        return self.factors.pop(0) * self.loss(path)


@pytest.mark.parametrize("zero_gradients", [True, False])
def test_recovery_returns_to_the_best_state_as_a_whole(problem, zero_gradients):
    """Law, optimizer and accumulated gradients are those of the best iteration, which was not the last good one; the
    step from there is shorter than the first time."""
    body, loss = problem
    keep, messages = MemoryCheckpoint(), []
    # iteration 0 accepted; 1 the best; 2 worse, but accepted; 3 diverged; 3 again, from the best state
    scripted = ScriptedLoss(loss, [1.0, 0.1, 0.2, 100.0, 0.1, 0.1])
    settings = SETTINGS.model_copy(
        update={"iterations": 4, "checkpoint_every": 1, "zero_gradients": zero_gradients}
    )
    train_material(
        MODEL, stiff_random_law(), body.state(V0), scripted, settings, checkpoint=keep, log=messages.append
    )
    best, after_best, _, recovered, again = keep.states  # each is the state after its iteration's step
    assert [len(state["history"]["recoveries"]) for state in keep.states] == [0, 0, 0, 1, 1]
    assert recovered["lr_scale"] == 0.5 and "back to the best state, that of iteration 1" in messages[0]
    for key in ("law", "optimizer", "gradients"):
        torch.testing.assert_close(recovered[key], best[key], rtol=0, atol=0)

    def step(state):
        return sum(float((state["law"][k] - w).square().sum()) for k, w in best["law"].items()) ** 0.5

    assert 0 < step(again) < step(after_best)


@pytest.mark.parametrize("slope", [0.0, 1e9])
def test_a_first_gradient_of_a_chaotic_motion_is_named(problem, slope, caplog):
    """Once, and with its norm."""
    body, loss = problem

    class Steep(ScriptedLoss):
        def __call__(self, path):
            return self.loss(path) + slope * (path.x - path.x.detach()).mean()

    settings = SETTINGS.model_copy(update={"iterations": 2})
    train_material(MODEL, stiff_random_law(), body.state(V0), Steep(loss, []), settings, log=lambda _: None)
    named = [text for text in caplog.messages if text.startswith("the first gradient has a norm of ")]
    assert len(named) == (1 if slope else 0)
    assert all(float(text.split("norm of ")[1].split(":")[0]) > 1e4 for text in named)


def test_a_run_that_is_killed_after_a_recovery_resumes_with_its_lower_rates(problem):
    """The step after the resume is of the uninterrupted run, bit by bit."""
    body, loss = problem
    factors = [1.0, 0.1, 100.0, 0.1, 0.1, 0.1]  # the third one diverges
    settings = SETTINGS.model_copy(update={"iterations": 4, "checkpoint_every": 1})
    whole, keep = MemoryCheckpoint(), MemoryCheckpoint(fail_after=3)
    train((body, ScriptedLoss(loss, factors)), settings=settings, checkpoint=whole)
    with pytest.raises(KeyboardInterrupt):
        train((body, ScriptedLoss(loss, factors)), settings=settings, checkpoint=keep)
    assert keep.states[-1]["lr_scale"] == 0.5 and keep.states[-1]["iteration"] == 2
    train((body, ScriptedLoss(loss, factors[3:])), settings=settings, checkpoint=keep)
    assert [state["lr_scale"] for state in keep.states] == [state["lr_scale"] for state in whole.states]
    for name, value in whole.states[-1]["law"].items():
        assert torch.equal(value, keep.states[-1]["law"][name]), name


def test_training_ends_marked_after_too_many_recoveries(problem):
    messages = []
    wild = TrainingConfig(
        iterations=8, lr_elastic=50.0, lr_plastic=5.0, max_recoveries=3, recovery_growth=1.0
    )
    body, loss = problem
    law = stiff_random_law()
    result = train_material(MODEL, law, body.state(V0), loss, wild, log=messages.append)
    assert len(result.history.recoveries) == len(messages) == 4 and not result.stable
    assert [entry["lr_scale"] for entry in result.history.recoveries] == [0.5, 0.25, 0.125, 0.0625]
    assert np.isfinite(result.best_loss) and result.best_loss <= result.history.loss[0]
    assert all(torch.isfinite(p).all() for p in law.parameters())


def test_a_law_that_fails_from_the_start_stops_loudly(problem):
    law = stiff_random_law()
    with torch.no_grad():
        law.elasticity.base[0][0, 0] = float("nan")
    with pytest.raises(NonFiniteError):
        train(problem, law)


def test_the_setting_of_the_adjoint_reaches_both_networks(problem):
    law = stiff_random_law()
    train(problem, law, SETTINGS.model_copy(update={"iterations": 1, "adjoint_precision": "half"}))
    parts = law.elasticity, law.plasticity
    assert [part.adjoint_precision for part in parts] == ["half", "half"]
    assert (
        law.elasticity.graph_key() != stiff_random_law().elasticity.graph_key()
    )  # graphs are recorded separately


def test_nothing_to_train_is_an_input_error(problem):
    with refused("law"):
        train(problem, neural_law(seed=0).to(torch.float64))


def test_particles_supervise_through_the_same_loop(problem):
    body, pixels = problem
    with torch.no_grad():
        softer = State(body.x0, V0, body.mass, body.vol0 * 0.5)
        path = rollout(MODEL, stiff_random_law(), softer, steps=60, frames=FRAMES)
    result = train((body, ParticleLoss(FRAMES, path.x)))
    assert result.best_loss < result.history.loss[0]


def test_gaussians_can_be_the_particles(problem):
    body, pixels = problem
    volume = float(body.vol0.sum())
    shell = Reconstruction.of_gaussians(body.gaussians, volume, 1000.0)
    assert float(shell.mass.sum()) == pytest.approx(1000 * volume)
    images = shell.particle_gs(camera())(
        shell.x0[None], torch.eye(3, dtype=torch.float64).expand(1, len(shell.x0), 3, 3)
    )
    bound = body.particle_gs(camera())(
        body.x0[None], torch.eye(3, dtype=torch.float64).expand(1, len(body.x0), 3, 3)
    )
    assert torch.allclose(images, bound, atol=1e-9)


def test_frame_weights_start_with_early_frames_and_end_uniform():
    settings = TrainingConfig(iterations=90)
    first, last = frame_weights(0, 10, settings), frame_weights(60, 10, settings)
    assert first.tolist() == [1, 1, 0.5, 0.5, 0.25, 0.25, 0.125, 0.125, 0.0625, 0.0625]
    assert last.tolist() == [1] * 10
    half = frame_weights(15, 10, settings)  # half of the first third
    assert half.tolist() == pytest.approx([0.75 ** (k // 2) for k in range(10)])
