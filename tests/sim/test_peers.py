"""The comparison with other engines: it times only what simulates the same."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import peers
from benchmarks.peer_engines import ANALYTIC, Case, OwnRollout
from tests.support.errors import refused

CASE = Case("neo_hookean", 64, 12, steps=4)
HERE = Path(peers.__file__).parents[1]


class Fixed:
    """An engine with a given result that takes a given time."""

    def __init__(self, name, result, seconds=0.004):
        self.name, self.result, self.time, self.peer = name, result, (seconds, seconds), peers.Peer()

    def prepare(self, case):
        return self.result

    def seconds(self, work):
        return self.time


@pytest.fixture(scope="module")
def own():
    rollout = OwnRollout(CASE, "cpu")
    rollout.forward_backward()
    return rollout.result()


def test_the_gradient_is_that_of_final_positions_along_the_direction():
    rollout = OwnRollout(CASE, "cpu")
    rollout.forward_backward()
    _, gradient = rollout.result()
    *_, direction = CASE.arrays()
    change = np.random.default_rng(1).standard_normal(gradient.shape).astype(np.float32)
    start, values = rollout.state.v.detach().clone(), []
    for sign in (1, -1):
        rollout.state.v.data.copy_(start + 0.2 * sign * rollout.direction.new_tensor(change))
        rollout.forward_backward()
        x, _ = rollout.result()
        values.append(float((x.astype(np.float64) * direction).sum()))
    assert (values[0] - values[1]) / 0.4 == pytest.approx(float((gradient * change).sum()), rel=1e-3)


@pytest.mark.parametrize("law", ["von_mises", "structured"])
def test_a_plastic_case_yields(law, monkeypatch):
    results = []
    for yield_stress in (ANALYTIC["von_mises"]["plasticity"]["yield_stress"], 1e9):
        monkeypatch.setitem(ANALYTIC["von_mises"]["plasticity"], "yield_stress", yield_stress)
        rollout = OwnRollout(replace(CASE, law=law, steps=50), "cpu")
        rollout.forward_backward()
        results.append(rollout.result())
    assert not peers.agree(*peers.differences(*results))


def test_a_checkout_in_a_process_gives_the_same_and_is_timed(own):
    child = peers.Child(peers.OTHER, HERE)
    try:
        printed = peers.compare(CASE, [Fixed(peers.OWN, own), child], rounds=3)
    finally:
        child.close()
    assert child.process.returncode == 0
    assert "positions differ by 0.0e+00 m, gradients by 0.0e+00" in printed
    assert printed.count(peers.OTHER) == 3  # the agreement and two rows


@pytest.mark.parametrize("part, by", [(0, 2e-5), (1, 1e-2), (0, np.nan)])
def test_engines_that_differ_are_not_timed(own, part, by):
    other = [each.copy() for each in own]
    other[part][0, 0] += by * (1 if part == 0 else np.linalg.norm(own[1]))
    with pytest.raises(RuntimeError, match="no times"):
        peers.compare(CASE, [Fixed(peers.OWN, own), Fixed("other", tuple(other))], rounds=1)


def test_a_table_has_times_of_a_step_and_paired_ratios():
    own, other = [(0.1, 0.5), (0.2, 0.5), (0.4, 0.6)], [(0.3, 0.3), (0.2, 0.4), (0.8, 0.9)]
    times = {(peers.OWN, "forward"): own, ("other", "forward"): other}
    first, second = (line.split() for line in peers.table(times, steps=100).splitlines()[1:])
    assert first[3:] == ["2.000", "1.000", "5.000", "1.00", "1.00", "to", "1.00"]
    assert second[2:] == ["3.000", "2.000", "4.000", "2.00", "1.00", "to", "3.00"]


def test_missing_engines_are_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(peers.importlib.util, "find_spec", lambda name: None)
    assert peers.installed(None) == []
    with refused("taichi", problem="not installed"):
        peers.installed(["taichi"])
    with refused("--against", remedy="git worktree"):
        peers.checked_checkout(tmp_path)


@pytest.mark.parametrize("name", peers.PEERS)
def test_another_engine_simulates_the_same(name):
    pytest.importorskip(name)
    if name == "genesis" and not os.environ.get("GENESIS"):
        pytest.skip("Genesis compiles for minutes: set GENESIS=1")
    peer = peers.PEERS[name]
    case = replace(CASE, law=peer.laws[-1])
    rollout, child = OwnRollout(case, "cpu"), peers.Child(name, HERE)
    rollout.forward_backward()
    try:
        assert peers.agree(*peers.differences(rollout.result(), child.prepare(case)), peer)
    finally:
        child.close()
