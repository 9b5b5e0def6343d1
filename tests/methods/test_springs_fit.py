"""Springs fitted to a video: gradients, recovered motions, resuming, files, and evaluation."""

import copy
from dataclasses import replace

import pytest
import torch

from neuma_lib.config.training import TrainingConfig
from neuma_lib.evaluation.motion import evaluate
from neuma_lib.fitting.material import PixelLoss
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.io.weights import write_weights
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.methods.spring_gaus.body import SpringBody
from neuma_lib.methods.spring_gaus.fit import fit_springs
from neuma_lib.methods.spring_gaus.io import load_springs, save_springs
from neuma_lib.methods.spring_gaus.method import SpringGaus
from neuma_lib.methods.spring_gaus.network import SpringNetwork, Springs
from neuma_lib.methods.spring_gaus.options import SpringsConfig
from neuma_lib.methods.spring_gaus.rollout import SpringModel, spring_rollout
from neuma_lib.sim.rollout import rollout
from neuma_lib.splatting.observation import Observation
from tests.support.errors import refused
from tests.support.gradients import check_directional_derivatives
from tests.support.grounding_scene import MODEL, TRUTH, ball, camera, observe

FRAMES = tuple(range(0, 91, 5))
V0 = (0.3, -1.5, 0.1)
DENSITY = 1000.0
BOX = SpringModel.of(MODEL)


def moved(springs, anchored, start, frames=FRAMES):
    with torch.no_grad():
        x, v, _ = spring_rollout(BOX, springs, *anchored.start(start), frames)
        return anchored.path(tuple(frames), x, v)


class Problem:
    """A ball on 80 anchors, filmed as springs moved it that are half as stiff as the guess, and not all alike."""

    def __init__(self, size=48, frames=FRAMES):
        self.body = ball()
        self.anchored = SpringBody.of(self.body.x0, 80, 16, 6, 0.5, 12)
        self.start = self.body.state(V0)
        self.truth = Springs.of_modulus(self.anchored.network, 1e5, DENSITY, 0.1)
        with torch.no_grad():
            noise = torch.randn(80, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
            self.truth.log_stiffness += 0.1 * noise
            self.truth.softness += 0.3
            self.truth.grip += 1
        self.path = moved(self.truth, self.anchored, self.start, frames)
        cameras = camera(size)
        with torch.no_grad():
            images = self.body.particle_gs(cameras)(self.path.x, self.path.F)
        self.loss = PixelLoss(self.body, Observation(tuple(frames), images, cameras))

    def guess(self):
        return Springs.of_modulus(self.anchored.network, 2e5, DENSITY, 0.1)

    def fit(self, settings, how, springs=None, **options):
        problem = (BOX, self.anchored, springs or self.guess(), self.start, self.loss, settings, how)
        return fit_springs(*problem, **{"log": lambda _: None, **options})

    def error(self, springs):
        """RMSE of the particles [mm]."""
        path = moved(springs, self.anchored, self.start, self.path.frames)
        return 1e3 * float((path.x - self.path.x).norm(dim=-1).square().mean().sqrt())


@pytest.fixture(scope="module")
def problem():
    return Problem()


@pytest.fixture(scope="module")
def small():
    return Problem(size=24, frames=(0, 30, 40, 55))


def test_gradient_from_springs_to_image_loss(small):
    springs = small.guess()
    parameters = dict(springs.named_parameters())
    generator = torch.Generator().manual_seed(0)

    def value():
        x, v, _ = spring_rollout(BOX, springs, *small.anchored.start(small.start), small.loss.frames)
        return small.loss(small.anchored.path(small.loss.frames, x, v)).mean()

    # The derivative jumps where an anchor touches the floor a substep earlier: the next one is less than 1e-6 m away.
    check_directional_derivatives(value, parameters, generator, h=1e-7, rel=1e-4, abs=1e-9)


def test_motion_of_springs_is_recovered_to_a_millimetre(problem):
    assert problem.error(problem.guess()) > 25
    known = SpringsConfig(truncated=False, lr_springs=0.05, learn_gap=False)
    fitted = problem.fit(TrainingConfig(iterations=150), known)
    assert fitted.stable and fitted.best_loss < 1e-3 * fitted.history.loss[0]
    assert problem.error(fitted.springs) < 1.0


def test_steps_of_single_frames_approach_it(problem):
    """As published; they cost as many renders as the whole gradient, and 18 optimiser steps in place of one."""
    known = SpringsConfig(truncated=True, lr_springs=0.02, learn_gap=False)
    fitted = problem.fit(TrainingConfig(iterations=12), known)
    assert problem.error(fitted.springs) < 2.0


@pytest.mark.slow
def test_motion_of_an_elastic_body_is_recovered_to_a_centimetre():
    """The truth is simulated on a grid. The fitted gap is the radius at which its particles touch the floor."""
    body, frames = ball(), tuple(range(0, 101, 5))
    anchored = SpringBody.of(body.x0, 120, 24, 6, 0.5, 16)
    start = body.state(V0)
    with torch.no_grad():
        law = analytic_law(TRUTH, MODEL.dt)
        path = rollout(MODEL, law, start, steps=frames[-1], frames=frames)
    springs = Springs.of_modulus(anchored.network, 2e5, DENSITY, 0.1)
    loss = PixelLoss(body, observe(body, V0, frames))
    how = SpringsConfig(truncated=False, lr_springs=0.05)
    fit_springs(BOX, anchored, springs, start, loss, TrainingConfig(iterations=100), how, log=lambda _: None)
    error = (moved(springs, anchored, start, frames).x - path.x).norm(dim=-1)
    assert 1e3 * float(error.square().mean().sqrt()) < 10


@pytest.mark.parametrize("truncated", [True, False])
def test_a_killed_fit_goes_on_to_the_same_bits(small, tmp_path, truncated):
    settings = TrainingConfig(iterations=4, checkpoint_every=2)
    how = SpringsConfig(truncated=truncated, lr_springs=0.05, learn_resistance=True)
    whole, states = small.fit(settings, how), []
    checkpoint = Checkpoint(tmp_path / "checkpoint.pt", {"run": 1})

    def kill(iteration, *_):
        if iteration == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        small.fit(settings, how, checkpoint=checkpoint, progress=kill)
    resumed = small.fit(settings, how, checkpoint=checkpoint, progress=lambda *now: states.append(now[:2]))
    assert states == [(3, 4), (4, 4)] and resumed.history.loss == whole.history.loss
    for name, value in whole.springs.state_dict().items():
        assert torch.equal(value, resumed.springs.state_dict()[name]), name


def test_springs_that_run_away_return_to_the_best(small):
    messages = []
    settings = TrainingConfig(iterations=9, max_recoveries=2)
    soft = Springs.of_modulus(small.anchored.network, 1e3, DENSITY, 0.1)
    before = copy.deepcopy(soft.state_dict())
    fitted = small.fit(settings, SpringsConfig(truncated=False, lr_springs=90.0), soft, log=messages.append)
    assert (
        not fitted.stable
        and len(fitted.history.recoveries) == 3
        and "best state, that of iteration 0" in messages[0]
    )
    assert all(torch.equal(value, before[name]) for name, value in fitted.springs.state_dict().items())


def test_what_is_not_learned_stays(small):
    how = SpringsConfig(truncated=False, learn_gap=False, lr_springs=0.05)
    fitted = small.fit(TrainingConfig(iterations=2), how)
    before, after = (copy.deepcopy(s.state_dict()) for s in (small.guess(), fitted.springs))
    assert {name for name in before if torch.equal(before[name], after[name])} == {"log_damping", "gap"}


def test_file_gives_the_same_motion_and_refuses_other_particles(small, tmp_path):
    file = tmp_path / "springs.safetensors"
    save_springs(file, small.anchored, small.truth, {"stable": True})
    index, springs, about = load_springs(file, small.body.x0)
    assert about["stable"] is True
    anchored = SpringBody.with_network(small.body.x0, index, springs.network, 12)
    again = moved(springs, anchored, small.start, small.path.frames)
    assert torch.equal(again.x, small.path.x) and torch.equal(again.F, small.path.F)
    with refused("springs"):
        SpringBody.with_network(small.body.x0 + 1e-3, index, springs.network, 12)
    write_weights(file, {"index": torch.arange(3)}, {})
    with refused("springs.safetensors"):
        load_springs(file, small.body.x0)


@pytest.fixture
def motion(small, tmp_path):
    """The true springs, from a file."""
    file = tmp_path / "springs.safetensors"
    save_springs(file, small.anchored, small.truth, {"stable": True, "substeps": 1, "density": DENSITY})
    options = {"anchors": 80, "neighbours": 16, "hard_springs": 6, "exponent": 0.5, "carriers": 12}
    return SpringGaus().load({"springs": str(file)}, options, MODEL.dt)


def test_springs_are_evaluated_as_any_model_is(small, motion):
    frames, tracers = small.path.frames, small.body.x0[::3] + 1e-3
    path, failure = motion.predict(MODEL, small.start, frames, tracers)
    assert failure is None and torch.equal(path.x, small.path.x)
    result = evaluate(MODEL, motion, small.start, frames, path.tracers, path.tracers, tracers)
    assert result.metrics["tracer_rmse_mm"] == result.metrics["chamfer"] == 0
    assert result.metrics["diverged"] is None and result.path.F.shape == (4, len(small.body.x0), 3, 3)
    assert result.metrics["energy_gain_after_step"] is result.metrics["courant"] is None and motion.stable


def test_springs_move_another_body_with_one_stiffness(small, motion):
    start = replace(small.start, x=small.start.x + torch.tensor([0.01, 0.0, 0.0]))
    path, failure = motion.predict(MODEL, start, small.path.frames)
    assert failure is None and path.x.shape == small.path.x.shape
    assert torch.equal(path.x[0], start.x) and not torch.equal(path.x[-1], small.path.x[-1])


def test_springs_that_diverge_are_held_at_the_last_sound_frame(small, motion, monkeypatch):
    monkeypatch.setattr("neuma_lib.methods.spring_gaus.rollout.MAX_SUBSTEPS", 1)
    monkeypatch.setattr(SpringNetwork, "stable_step", lambda *_: 1.0)
    stiff = Springs.of_modulus(small.anchored.network, 1e8, DENSITY, 0.1)
    save_springs(motion._path, small.anchored, stiff, {"stable": True, "substeps": 1, "density": DENSITY})
    frames = small.path.frames
    path, failure = motion.predict(MODEL, small.start, frames, small.body.x0[:9])
    sound = sum(n < failure.step for n in frames)
    assert 0 < sound < len(frames) and "spacing of the anchors" in failure.happened
    assert torch.equal(
        path.tracers[sound:], path.tracers[sound - 1 : sound].expand(len(frames) - sound, 9, 3)
    )
