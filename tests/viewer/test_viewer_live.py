"""The live simulation executes commands, can always be reset, and equals `rollout`."""

import time

import numpy as np
import pytest
import torch

from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.law import Elasticity, Law
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.sim.colliders import Collider
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from neuma_lib.viewer.live import EARTH, FRAME, MAX_SPEED, PIVOT, LiveSimulation, tilted
from tests.support.sim_scenes import DENSITY, SPECS, cube, make_law

CONSTANTS = {"grid": 16, "boundary": "no_slip", "contact": "particles"}
DT = 1e-3


def start(height=0.3, count=200, velocity=(0.0, 0.0, 0.0)):
    x, mass, vol0 = cube(count, 0.25, (0.5, height, 0.5), dtype=torch.float32)
    return State.rigid(x, mass, vol0, velocity)


@pytest.fixture
def live():
    opened = []

    def make(law=None, paused=False, constants=CONSTANTS, **options):
        live = LiveSimulation(constants, start(**options), law or make_law("hencky", torch.float32), DT)
        live.run(not paused)
        opened.append(live.open())
        return live

    yield make
    for each in opened:
        each.close()


class Exploding(Elasticity):
    """A stress that diverges at any deformation."""

    def response(self, F, weights):
        return 1e12 * (F + 0.1)


def exploding():
    return Law(Exploding(), make_law("hencky", torch.float32).plasticity, name="exploding")


def reached(live, condition, timeout=20.0):
    """The first snapshot that fulfils a condition."""
    until = time.monotonic() + timeout
    while not condition(live.snapshot):
        assert time.monotonic() < until, "not reached in time"
        live.wait(live.snapshot.number + 1, 1.0)
    return live.snapshot


def test_it_simulates_what_a_rollout_does(live):
    result = reached(live(), lambda s: s.time > 0.25)
    live_x, steps = result.x, round(result.time / DT)
    assert steps == pytest.approx(result.time / DT, abs=1e-6)
    model = MPM(**CONSTANTS, dt=DT, gravity=(0.0, -EARTH, 0.0))
    wanted = rollout(
        model, make_law("hencky", torch.float32), start(), steps=steps, frames=[steps], total=True
    )
    # float32, rounded where the frames part
    assert torch.allclose(live_x, wanted.x[0], atol=2e-4)
    assert torch.allclose(result.total, wanted.F_total[0], atol=5e-3)
    assert (result.F - torch.eye(3)).abs().max() > 1e-3, "it has touched the floor"


def test_colliders_move_on_from_frame_to_frame(live):
    """A lift rises through the body, and lifts it as in one rollout."""
    moving = {"velocity": (0.0, 1.0, 0.0), "spin": (0.0, 1.0, 0.0)}
    lift = Collider("box", (0.4, 0.02, 0.4), (0.5, 0.05, 0.5), **moving)
    constants = {"grid": 16, "contact": "particles", "colliders": (lift,)}
    result = reached(live(constants=constants, height=0.21), lambda s: s.time > 0.06)
    steps = round(result.time / DT)
    model = MPM(**constants, dt=DT, gravity=(0.0, -EARTH, 0.0))
    wanted = rollout(model, make_law("hencky", torch.float32), start(0.21), steps=steps, frames=[steps])
    assert torch.allclose(result.x, wanted.x[0], atol=2e-4)  # float32, rounded where the frames part
    surface = 0.07 + result.time
    assert surface - 0.02 < float(result.x[:, 1].min()) < surface + 0.1


def test_a_tilted_floor_rotates_gravity(live):
    simulation = live(height=0.5)
    simulation.set_floor(20.0, -10.0)
    simulation.reset()
    simulation.do()
    result = reached(simulation, lambda s: s.time > 0.1)
    steps = round(result.time / DT)
    gravity = tilted(20.0, -10.0).T @ [0.0, -EARTH, 0.0]
    model = MPM(**CONSTANTS, dt=DT, gravity=tuple(gravity.tolist()))
    law = make_law("hencky", torch.float32)
    wanted = rollout(model, law, start(height=0.5), steps=steps, frames=[steps])
    assert np.linalg.norm(gravity) == pytest.approx(EARTH) and abs(gravity[0]) > 1
    assert torch.allclose(result.x, wanted.x[0], atol=2e-4)
    down = simulation.floor @ np.asarray(gravity)
    assert np.allclose(down, [0, -EARTH, 0]), "seen in the room it points down"
    place = np.array([0.7, 0.2, 0.4])
    back = simulation.floor @ (simulation.place_in_box(place) - PIVOT) + PIVOT
    assert np.allclose(back, place)


def test_a_diverging_law_is_reported_until_a_reset(live):
    simulation = live(height=0.14)
    simulation.set_law(exploding(), DT)
    result = reached(simulation, lambda s: s.trouble)
    assert "unstable" in result.trouble or "not finite" in result.trouble
    assert result.x.isfinite().all() and result.F.isfinite().all(), "the last good state stays on the screen"
    before = simulation.do()
    assert simulation.wait(before.number + 2).time == before.time, "it waits"
    simulation.set_law(make_law("hencky", torch.float32), DT)
    simulation.reset()
    assert simulation.do().trouble is None
    assert reached(simulation, lambda s: s.time > 0.05).trouble is None


def test_an_error_of_a_law_does_not_end_the_thread(live):
    class Broken(Elasticity):
        def response(self, F, weights):
            raise RuntimeError("no such file")

    law = make_law("hencky", torch.float32)
    simulation = live(height=0.14)
    simulation.set_law(Law(Broken(), law.plasticity), DT)
    assert "RuntimeError: no such file" in reached(simulation, lambda s: s.trouble).trouble
    simulation.set_law(law, DT)
    simulation.reset()
    assert reached(simulation, lambda s: s.time > 0.02).trouble is None


def test_an_error_of_a_command_does_not_end_the_thread(live):
    simulation = live(paused=True)
    simulation.set_weight("heavy")
    assert "could not convert" in simulation.do().notice
    for place in (["a"], (0.5, 0.5), (float("nan"), 0.5, 0.5)):
        simulation.hold(place)
        assert simulation.do().notice and simulation._hand is None
    simulation.run(True)
    assert reached(simulation, lambda s: s.time > 0).trouble is None


def test_the_message_of_a_divergence_names_body_and_law(live):
    simulation = live(height=0.2)
    simulation.add(start(), exploding(), DT)
    trouble = reached(simulation, lambda s: s.trouble).trouble
    assert "Body 2" in trouble and "'exploding'" in trouble and "speed" in trouble


def test_limits_of_speed_and_height_are_announced(live):
    simulation = live(paused=True)
    simulation.launch((0.0, 2.0, 0.0))
    assert simulation.do().notice is None
    simulation.launch((0.0, 2.0 * MAX_SPEED, 0.0))
    assert f"limited to {MAX_SPEED:g} m/s" in simulation.do().notice
    simulation.drop(0.4)
    assert simulation.do().notice is None
    simulation.drop(0.9)
    assert "by the ceiling" in simulation.do().notice


def test_reset_restores_the_start_bit_by_bit(live):
    simulation = live()
    reached(simulation, lambda s: s.time > 0.1)
    simulation.add(start(), make_law("von_mises", torch.float32), DT)
    simulation.launch((1.0, 0.0, 0.0))
    assert simulation.do().counts == (200, 200)
    simulation.run(False)
    simulation.reset()
    result = simulation.do()
    assert torch.equal(result.x, start().x) and result.time == 0 and result.counts == (200,)
    assert torch.equal(result.F, torch.eye(3).expand(200, 3, 3))


def test_rate_and_pace_are_not_biased_by_uneven_frames(monkeypatch):
    simulation = LiveSimulation(CONSTANTS, start(), make_law("hencky", torch.float32), DT)  # no thread
    clock = simulation._measured
    monkeypatch.setattr(time, "perf_counter", lambda: clock)
    for k in range(100):
        clock += 0.002 if k % 2 else 0.098  # 20 frames a second
        simulation._time += 0.02
        simulation._measure()
    simulation._publish()
    assert simulation.snapshot.rate == pytest.approx(20, rel=0.2)
    assert simulation.snapshot.pace == pytest.approx(0.4, rel=0.2)


def test_it_runs_in_real_time_during_commands(live):
    simulation, steps = live(paused=True), []

    def quick():  # as on a machine that is never late
        steps.append(simulation._time)
        simulation._time += 0.011

    simulation._advance = quick
    simulation.do()
    began = time.perf_counter()
    simulation.run(True)
    while time.perf_counter() - began < 0.5:
        simulation.set_gravity(EARTH)  # a drag sends some sixty commands a second
        time.sleep(0.002)
    simulation.run(False)
    moved, passed = simulation.do().time, time.perf_counter() - began
    assert moved == pytest.approx(0.011 * len(steps))
    assert 0.3 * passed < moved < passed + FRAME + 0.022


def test_launch_drop_and_gravity(live):
    simulation = live(paused=True)
    simulation.launch((1.0, 2.0, 0.0))
    assert torch.allclose(simulation.do().v, torch.tensor([1.0, 2.0, 0.0]))
    simulation.launch((0.0, 1000.0, 0.0))
    assert torch.allclose(simulation.do().v, torch.tensor([0.0, MAX_SPEED, 0.0]))
    simulation.launch((float("nan"), 0.0, 0.0))
    result = simulation.do()
    assert "not finite" in result.notice and result.v.isfinite().all() and result.trouble is None
    simulation.drop(0.4)
    result = simulation.do()
    assert result.x[:, 1].min() == pytest.approx(0.4, abs=1e-6) and result.v.abs().max() == 0
    simulation.drop(50.0)
    assert simulation.do().x[:, 1].max() < 1
    simulation.drop(0.4)
    simulation.set_gravity(0.0)
    simulation.run(True)
    begun = simulation.do().time
    result = reached(simulation, lambda s: s.time > begun + 0.05)
    assert result.x[:, 1].min() == pytest.approx(0.4, abs=1e-5), "it hovers"


def test_a_held_body_follows_the_hand_and_keeps_its_velocity(live):
    simulation = live(height=0.4)
    simulation.set_gravity(0.0)
    simulation.hold((0.7, 0.6, 0.5))
    centre = lambda s: s.x.mean(dim=0)  # noqa: E731
    wanted = torch.tensor([0.7, 0.6, 0.5])
    reached(simulation, lambda s: (centre(s) - wanted).norm() < 0.02)
    simulation.hold((0.3, 0.6, 0.5))
    reached(simulation, lambda s: centre(s)[0] < 0.6)
    simulation.hold(None)
    result = simulation.do()
    assert result.v[:, 0].mean() < -0.5, "it keeps the velocity of the hand"
    simulation.hold((9.0, -9.0, 0.5))
    assert reached(simulation, lambda s: s.time > result.time + 0.4).trouble is None, "never through a wall"


def test_the_weight_of_the_adaptor_is_kept_by_other_laws(live):
    law = neural_law(seed=1)
    law.attach_adaptor(rank=4, seed=1)
    simulation = live(law, paused=True)
    simulation.set_weight(0.25)
    simulation.do()
    assert {part.adaptor.weight for part in law.parts.values()} == {0.25}
    simulation.set_law(make_law("hencky", torch.float32), DT)  # has none
    simulation.set_weight(1.25)
    assert simulation.do().notice is None
    simulation.set_law(law, DT)
    simulation.do()
    assert {part.adaptor.weight for part in law.parts.values()} == {1.25}


def test_bodies_are_added_above_each_other_while_there_is_room(live):
    simulation = live(height=0.2, paused=True)
    law = make_law("hencky", torch.float32)
    simulation.add(start(), law, 5e-4)
    result = simulation.do()
    first, second = result.x.split(list(result.counts))
    assert second[:, 1].min() - first[:, 1].max() > 1 / 16 and result.dt == 5e-4, "the smaller step counts"
    simulation.add(start(), law, DT)
    result = simulation.do()
    assert "no room" in result.notice and result.counts == (200, 200) and result.trouble is None
    simulation.run(True)
    result = reached(simulation, lambda s: s.time > 0.05)
    assert result.trouble is None


def test_a_network_is_simulated_at_its_own_step_only(live):
    simulation, network = live(height=0.2, paused=True), neural_law(seed=1)
    simulation.set_law(network, DT)
    assert simulation.do().notice is None
    simulation.add(start(), make_law("hencky", torch.float32), DT / 2)
    result = simulation.do()
    assert "another material" in result.notice and result.counts == (200,) and result.dt == DT
    simulation.add(start(), network, DT)
    simulation.set_law(neural_law(seed=2), DT / 2)
    result = simulation.do()
    assert "reset" in result.notice and result.counts == (200, 200) and result.dt == DT
    simulation.reset()
    simulation.set_law(neural_law(seed=2), DT / 2)
    result = simulation.do()
    assert result.notice is None and result.dt == DT / 2


def test_commands_are_not_delayed_by_a_slow_law(live):
    """A command is executed after the current frame, however long it takes."""

    class Slow(Elasticity):
        def response(self, F, weights):
            time.sleep(0.02)
            return torch.zeros_like(F)

    law = analytic_law(SPECS["hencky"], dt=DT)
    simulation = live(Law(Slow(), law.plasticity), height=0.14, velocity=(0.0, -1.0, 0.0))
    reached(simulation, lambda s: s.number > 5 and s.time > 0)
    began = time.monotonic()
    simulation.reset()
    assert simulation.do().time < 0.2 and time.monotonic() - began < 3.0  # a frame takes 0.06 s
    assert start().density[0] == pytest.approx(DENSITY)
