"""Evaluation of predicted motions with known errors."""

import math

import pytest
import torch

from neuma_lib.errors import NonFiniteError
from neuma_lib.evaluation.motion import energy_gain_after, evaluate
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Elasticity, Law
from neuma_lib.methods.model import LawOnGrid
from neuma_lib.sim.prediction import predict, valid_frames
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import Trajectory
from tests.support.errors import refused
from tests.support.grounding_scene import HEIGHT, MODEL, PRIOR, RADIUS, TRUTH, ball

pytestmark = pytest.mark.core

V0 = torch.tensor([0.3, -1.5, 0.1], dtype=torch.float64)
LAW = analytic_law(TRUTH, MODEL.dt)
IN_FLIGHT = [0, 5, 10, 20]  # frames before the ball of `ball()` touches the floor


def in_ball(count: int, seed: int, height: float = HEIGHT) -> torch.Tensor:
    """Uniform points in the ball of `ball()`."""
    g = torch.Generator().manual_seed(seed)
    direction = torch.randn(count, 3, generator=g, dtype=torch.float64)
    radius = RADIUS * torch.rand(count, 1, generator=g, dtype=torch.float64) ** (1 / 3)
    centre = torch.tensor([0.5, height, 0.5], dtype=torch.float64)
    return centre + radius * direction / direction.norm(dim=1, keepdim=True)


def true_tracers(body, frames, *starts, law=LAW) -> list[torch.Tensor]:
    """Paths of tracers in the motion of a body under the true law, one (T, M, 3) for each set of starts."""
    with torch.no_grad():
        path = rollout(MODEL, law, body.state(V0), steps=frames[-1], frames=frames, tracers=torch.cat(starts))
    return path.tracers.split([len(points) for points in starts], dim=1)


def test_error_of_the_true_law_on_other_particles_is_that_of_sampling():
    particles, tracers = 1500, 500
    # In flight, and after the motions under the true and the stiffer law have separated.
    frames = [0, 20, 75, 87, 100]
    truth, again = true_tracers(
        ball(count=particles, seed=0), frames, in_ball(tracers, 10), in_ball(tracers, 11)
    )
    body, starts = ball(count=particles, seed=1), in_ball(tracers, 12)
    result, wrong = (
        evaluate(MODEL, LawOnGrid(law), body.state(V0), frames, truth, again, starts).metrics
        for law in (LAW, analytic_law(PRIOR, MODEL.dt))
    )
    # A coordinate of uniform points in the ball has the variance R^2 / 5, so the centres of mass of two random sets
    # are sqrt(2 * 3 * R^2 / (5 N)) shifted; the floor meets each with its own. Three standard deviations.
    limit = 3e3 * math.sqrt(6 / (5 * particles)) * RADIUS
    assert result["tracer_rmse_mm"] < limit < wrong["tracer_rmse_mm"] / 3
    assert max(result["tracer_rmse_mm_per_frame"][:2]) < 1e-9  # before contact no sampling matters
    # Squared distances r^2 to the nearest of M points (r^3 is exponential) deviate by 0.68 of their mean. Two sets of
    # M against the truth, two directions each, whose neighbours share points (a factor of sqrt(2) at most): three
    # standard deviations of the difference.
    floor = result["chamfer_floor"]
    sampling = 3 * 0.68 * floor / math.sqrt(tracers) * math.sqrt(2)
    # Tracers that are e away from where they should be change mean r^2 by at most 2 e r + e^2, in both directions.
    e = 1e-3 * result["tracer_rmse_mm"]
    displaced = 2e4 * (2 * e * math.sqrt(0.5e-4 * floor) + e**2)
    assert abs(result["chamfer_excess"]) < sampling + displaced < wrong["chamfer_excess"]
    in_flight = [a - b for a, b in zip(result["chamfer_per_frame"], result["chamfer_floor_per_frame"])][:2]
    assert max(map(abs, in_flight)) < sampling
    assert result["diverged_at_step"] is result["diverged"] is result["energy_gain_after_step"] is None


def test_a_known_shift_of_the_truth_is_the_error():
    """Tracers on a lattice wider than twice the shift, so that nearest neighbours are the same tracers."""
    shift = torch.tensor([3e-3, 0.0, 4e-3], dtype=torch.float64)  # 5 mm
    axis = 0.03 * torch.arange(-2, 3, dtype=torch.float64)
    lattice = torch.cartesian_prod(axis, axis, axis) + torch.tensor([0.5, HEIGHT, 0.5], dtype=torch.float64)
    (path,) = true_tracers(ball(), IN_FLIGHT, lattice)
    truth = path + shift
    truth[0] = lattice
    evaluation = evaluate(MODEL, LawOnGrid(LAW), ball(seed=1).state(V0), IN_FLIGHT, truth, path, lattice)
    result = evaluation.metrics
    assert result["tracer_rmse_mm_per_frame"] == pytest.approx([0, 5, 5, 5], abs=1e-9)
    assert result["tracer_rmse_mm"] == pytest.approx(5 * math.sqrt(3 / 4), rel=1e-9)
    assert (
        result["tracer_error_p95_mm"]
        == pytest.approx(result["tracer_rmse_last_mm"])
        == pytest.approx(5, rel=1e-9)
    )
    # 25 mm^2 in both directions, in units of 1e-4 m^2: for the prediction, and for the floor that is shifted too.
    assert result["chamfer_per_frame"] == pytest.approx([0, 0.5, 0.5, 0.5], rel=1e-9, abs=1e-12)
    assert result["chamfer_floor_per_frame"] == result["chamfer_per_frame"]
    assert result["chamfer"] == pytest.approx(0.375) and result["chamfer_excess"] == 0
    torch.testing.assert_close(evaluation.tracers, path)
    # The prediction is wrong by the fall that a slower start lacks.
    slower = evaluate(
        MODEL, LawOnGrid(LAW), ball(seed=1).state(V0 + shift), IN_FLIGHT, path, path, lattice
    ).metrics
    late = [1e3 * 5e-3 * MODEL.dt * step for step in IN_FLIGHT]
    assert slower["tracer_rmse_mm_per_frame"] == pytest.approx(late, abs=1e-9)


def test_every_frame_and_the_floor_count():
    """The truth deviates in the last frame only. The other set of points of the truth is that of the prediction, so
    that the floor equals the distance, or is 5 mm from it in all frames, so that the excess is negative."""
    axis = 0.03 * torch.arange(-2, 3, dtype=torch.float64)
    lattice = torch.cartesian_prod(axis, axis, axis) + torch.tensor([0.5, HEIGHT, 0.5], dtype=torch.float64)
    (path,) = true_tracers(ball(), IN_FLIGHT, lattice)
    shift = torch.tensor([3e-3, 0.0, 4e-3], dtype=torch.float64)  # 5 mm
    truth = path.clone()
    truth[-1] += shift
    common = MODEL, LawOnGrid(LAW), ball(seed=1).state(V0), IN_FLIGHT
    result = evaluate(*common, truth, path, lattice).metrics
    assert result["frames"] == IN_FLIGHT and len(result["chamfer_per_frame"]) == len(IN_FLIGHT)
    assert result["tracer_rmse_mm_per_frame"] == pytest.approx([0, 0, 0, 5], abs=1e-9)
    assert result["tracer_rmse_mm"] == pytest.approx(2.5) and result["tracer_rmse_last_mm"] == pytest.approx(
        5
    )
    assert result["chamfer"] == result["chamfer_floor"] == pytest.approx(0.125)
    assert result["chamfer_excess"] == 0
    shifted = evaluate(*common, path, path + shift, lattice).metrics
    assert shifted["chamfer"] == pytest.approx(0, abs=1e-12) and shifted["chamfer_floor"] == pytest.approx(
        0.5
    )
    assert shifted["chamfer_excess"] == pytest.approx(-0.5)


class FailsOnce(Elasticity):
    """The true elasticity, except for NaN at one evaluation. A simulation evaluates it once a step."""

    def __init__(self, step: int):
        super().__init__()
        self.step, self.count = step, 0

    def response(self, F, weights):
        self.count += 1
        return LAW.elasticity.response(F, weights) * (math.nan if self.count == self.step else 1)


ON_THE_FLOOR = RADIUS - 0.01
"""Height at which particles of the ball feel the floor from the first step on."""


def test_a_diverging_motion_keeps_its_last_finite_frame():
    frames, body = [0, 4, 8, 12], ball(height=ON_THE_FLOOR)
    tracers = in_ball(50, 0, ON_THE_FLOOR)
    (truth,) = true_tracers(body, frames, tracers)
    evaluation = evaluate(
        MODEL, LawOnGrid(Law(FailsOnce(6), LAW.plasticity)), body.state(V0), frames, truth, truth, tracers
    )
    path, result = evaluation.path, evaluation.metrics
    assert result["diverged_at_step"] == 6
    assert result["diverged"] == {"happened": "became non-finite", "step": 6, "particle": 0}
    assert evaluation.summary().endswith("DIVERGED: a particle became non-finite at step 6")
    assert path.frames == (0, 4, 4, 4) and len(result["chamfer_per_frame"]) == 4
    sound, _ = predict(MODEL, LAW, body.state(V0), [0, 4])
    for name in ("x", "F", "tracers"):
        values = getattr(path, name)
        assert torch.isfinite(values).all()
        assert torch.equal(values[2], values[1]) and torch.equal(values[3], values[1])
    for name in ("x", "F"):  # to rounding, since a law without a kernel is evaluated by torch
        torch.testing.assert_close(getattr(path, name)[:2], getattr(sound, name), rtol=0, atol=1e-12)
    errors = result["tracer_rmse_mm_per_frame"]
    assert errors[:2] == pytest.approx([0, 0], abs=1e-9)
    expected = 1e3 * (truth[1] - truth[3]).square().sum(-1).mean().sqrt()  # the truth goes on
    assert errors[3] == pytest.approx(float(expected)) and errors[3] > errors[2] > 1


class Repelling(Elasticity):
    """The true elasticity with the opposite sign, which increases deformations."""

    def response(self, F, weights):
        return -LAW.elasticity.response(F, weights)


def test_an_unstable_motion_gains_energy_before_it_fails():
    """The kind of failure is read from the first invalid number, the energy from a frame before it."""
    frames, body = list(range(0, 61, 2)), ball(height=ON_THE_FLOOR)
    tracers = in_ball(50, 0, ON_THE_FLOOR)
    (truth,) = true_tracers(body, frames, tracers)
    result = evaluate(
        MODEL, LawOnGrid(Law(Repelling(), LAW.plasticity)), body.state(V0), frames, truth, truth, tracers
    ).metrics
    failure = result["diverged"]
    assert failure["happened"] != "became non-finite" and failure["step"] == result["diverged_at_step"]
    assert 0 <= result["energy_gain_after_step"] < failure["step"] - 2
    sound = evaluate(MODEL, LawOnGrid(LAW), body.state(V0), frames, truth, truth, tracers).metrics
    assert sound["diverged"] is sound["energy_gain_after_step"] is None


def test_the_energy_is_gained_after_the_last_frame_that_has_no_more():
    """Of frames with 1, 1.005, 1.5, 0.9 and 2 times the initial kinetic energy, without gravity."""
    body = ball().state(V0)
    frames, factors = (0, 4, 8, 12, 16), torch.tensor([1.0, 1.005, 1.5, 0.9, 2.0], dtype=torch.float64)
    x, v, F, C = (value.expand(5, *value.shape) for value in body.motion)
    path = Trajectory(frames, x, v * factors.sqrt()[:, None, None], F, C)
    assert energy_gain_after((0.0, 0.0, 0.0), body, path) == 4
    later = Trajectory(tuple(n + 20 for n in frames[2:]), x[2:], path.v[2:], F[2:], C[2:])
    assert energy_gain_after((0.0, 0.0, 0.0), body, later) == 0, "before the first frame"
    sound = Trajectory(frames[:2], x[:2], path.v[:2], F[:2], C[:2])
    assert energy_gain_after((0.0, 0.0, 0.0), body, sound) is None


def test_a_failure_without_a_step_gives_up_one_frame_after_the_other():
    """And the last frame that can be simulated is held."""
    tried, body = [], ball().state(V0)

    def simulate(frames):
        tried.append(list(frames))
        if len(frames) > 2:
            raise NonFiniteError("test", "unknown step")
        return rollout(MODEL, LAW, body, steps=frames[-1], frames=frames)

    path, failure = valid_frames(simulate, (0, 4, 8, 12))
    assert tried == [[0, 4, 8, 12], [0, 4, 8], [0, 4]] and failure.step is None
    assert path.frames == (0, 4, 4, 4) and torch.equal(path.x[3], path.x[1])


def test_a_floor_of_other_counts_is_refused():
    (truth, again) = true_tracers(ball(), IN_FLIGHT, in_ball(40, 0), in_ball(41, 1))
    with refused("evaluation.tracers", problem="the truth has 40 and 41 tracers, the prediction has 50"):
        evaluate(MODEL, LawOnGrid(LAW), ball().state(V0), IN_FLIGHT, truth, again, in_ball(50, 2))


def test_a_motion_without_a_finite_frame_is_an_error():
    with pytest.raises(NonFiniteError, match="step 2"):
        predict(MODEL, Law(FailsOnce(2), LAW.plasticity), ball(height=ON_THE_FLOOR).state(V0), [4, 8])


def test_a_motion_that_stays_finite_is_the_rollout():
    frames, body = [0, 10, 40], ball()
    path, failure = predict(MODEL, LAW, body.state(V0), frames)
    with torch.no_grad():
        expected = rollout(MODEL, LAW, body.state(V0), steps=40, frames=frames)
    assert failure is None and torch.equal(path.x, expected.x) and torch.equal(path.F, expected.F)
    assert path.F_total is None, "only on request"
