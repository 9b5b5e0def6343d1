"""Errors of stresses with closed forms, states of a motion, and the table with its claims."""

import csv
import io
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from neuma_lib.evaluation.material_point import returned
from neuma_lib.evaluation.response import half_width
from neuma_lib.evaluation.stress import PARTS, VisitedStates, stress_errors, visit
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.catalogue import lame
from neuma_lib.mechanics.elasticity import Hencky
from neuma_lib.mechanics.law import Law, Plasticity
from neuma_lib.paper.claims import Bound
from neuma_lib.paper.published import OUTSIDE, PAPER, PaperTable
from neuma_lib.paper.stress_table import stress_table
from neuma_lib.sim.state import State
from tests.support.errors import refused
from tests.support.grounding_scene import MODEL, ball

pytestmark = pytest.mark.core

E, NU, YIELD = 3e4, 0.3, 300.0
FRAMES = (0, 20, 40, 60)
V0 = torch.tensor([0.0, -1.5, 0.0], dtype=torch.float64)


def hencky(E=E, nu=NU, yield_stress=None):
    plastic = (
        {} if yield_stress is None else {"plasticity": {"name": "von_mises", "yield_stress": yield_stress}}
    )
    return analytic_law({"elasticity": {"name": "hencky", "E": E, "nu": nu}, **plastic})


def of(truth, states=400, paths=50):
    return visit(MODEL, truth, ball().state(V0), FRAMES, states, paths, seed=0)


@pytest.fixture(scope="module")
def elastic():
    return of(hencky())


@pytest.fixture(scope="module")
def plastic():
    return of(hencky(yield_stress=YIELD))


def test_states_are_after_contact_and_survive_a_file(plastic, tmp_path):
    truth = hencky(yield_stress=YIELD)
    assert plastic.F.shape == (400, 3, 3) and plastic.C.shape == (61, 50, 3, 3)
    assert plastic.frames and set(plastic.frames) <= set(FRAMES)
    torch.testing.assert_close(returned(truth, plastic.F_trial), plastic.F, atol=1e-9, rtol=0)
    strained = (plastic.F - torch.eye(3, dtype=torch.float64)).abs().amax(dim=(1, 2))
    assert (strained > 1e-3).double().mean() > 0.5
    assert ((plastic.F_trial - plastic.F).abs().amax(dim=(1, 2)) > 1e-6).any(), "nothing yields"
    write_arrays(tmp_path / "visited.h5", plastic.arrays())
    again = VisitedStates.of_arrays(read_arrays(tmp_path / "visited.h5")[0])
    assert torch.equal(again.F, plastic.F) and again.frames == plastic.frames
    assert torch.equal(of(truth).F, plastic.F)


def test_particles_are_drawn_in_proportion_to_their_volume():
    start = ball().state(V0)
    vol0 = torch.full_like(start.vol0, 1e-12)
    vol0[7] = 1e-9  # of hundreds, one that has almost all of it
    uneven = State(start.x, start.v, start.mass, vol0)
    visited = visit(MODEL, hencky(1.0), uneven, (0, 50, 60), 300, 10, seed=0)
    _, counts = visited.F.unique(dim=0, return_counts=True)
    assert counts.max() > 80 and len(visited.F) - counts.topk(2).values.sum() < 120


def test_the_true_law_has_no_error(plastic):
    truth = hencky(yield_stress=YIELD)
    errors = stress_errors(truth, truth, plastic, MODEL.dt)
    assert all(errors[part] == 0 for part in PARTS)
    assert errors["broken_paths"] == 0 and errors["asymmetric"] < 1e-12 and errors["true_rms"] > 10


def test_error_of_double_stiffness_is_the_stress(elastic):
    errors = stress_errors(hencky(2 * E), hencky(), elastic, MODEL.dt)
    assert all(errors[part] == pytest.approx(1.0, rel=1e-9) for part in PARTS)


def test_volumetric_and_deviatoric_parts_are_distinguished(elastic):
    """Another bulk modulus at the same shear modulus."""
    mu, lam = lame(E, NU)
    bulk = 1.5 * (lam + 2 * mu / 3)
    other = hencky(9 * bulk * mu / (3 * bulk + mu), (3 * bulk - 2 * mu) / (2 * (3 * bulk + mu)))
    errors = stress_errors(other, hencky(), elastic, MODEL.dt)
    assert errors["volumetric"] == pytest.approx(0.5, rel=1e-6) and errors["deviatoric"] < 1e-6
    assert 0 < errors["stress"] < 0.5 and errors["returned"] == pytest.approx(errors["stress"], rel=1e-2)


def test_flow_affects_the_stress_along_paths():
    """A steady shear far beyond yield: half the stiffness is half the stress of an elastic state, and the same flow."""
    dt, steps = 1e-3, 200
    C = torch.zeros(steps + 1, 2, 3, 3, dtype=torch.float64)
    C[1:, :, 0, 1] = torch.tensor([5.0, -3.0])
    F = torch.eye(3, dtype=torch.float64) + dt * C[steps]
    late = VisitedStates(F, F, C, frames=(100, 200))
    truth, softer = hencky(yield_stress=YIELD), hencky(E / 2, yield_stress=YIELD)
    errors = stress_errors(softer, truth, late, dt)
    assert errors["deviatoric"] == pytest.approx(0.5, rel=1e-9)
    # What is left: the plateaus of two simple shears turn their principal axes a little apart.
    assert errors["path"] < 0.02
    assert stress_errors(hencky(), truth, late, dt)["path"] > 5, "without a return map"
    early = VisitedStates(F, F, C, frames=(1,))
    assert stress_errors(softer, truth, early, dt)["path"] == pytest.approx(0.5, rel=1e-9)


def test_the_return_map_of_a_step_counts(plastic):
    errors = stress_errors(hencky(), hencky(yield_stress=YIELD), plastic, MODEL.dt)
    assert errors["stress"] == 0 and errors["returned"] > 0.02 and errors["path"] > 0.2


class Broken(Plasticity):
    """A return map that fails beyond a shear."""

    def response(self, F, weights):
        far = F[:, 0, 1].abs() > 0.01
        return torch.where(far[:, None, None], torch.nan, F)


class Lopsided(Hencky):
    """A stress with an antisymmetric part a tenth of its size."""

    def response(self, F, weights):
        tau = super().response(F, weights)
        skew = torch.tensor([[0, 1, 0], [-1, 0, 0], [0, 0, 0]], dtype=tau.dtype) / 2**0.5
        return tau + 0.1 * tau.square().sum(dim=(1, 2), keepdim=True).sqrt() * skew


def test_broken_paths_are_counted_and_left_out(elastic):
    truth = hencky()
    errors = stress_errors(Law(truth.elasticity, Broken()), truth, elastic, MODEL.dt)
    assert 0 < errors["broken_paths"] < 50 and errors["path"] == pytest.approx(0.0, abs=1e-12)


def test_stress_that_is_not_symmetric(elastic):
    errors = stress_errors(Law(Lopsided(E=E, nu=NU), hencky().plasticity), hencky(), elastic, MODEL.dt)
    assert errors["asymmetric"] == pytest.approx(0.1, rel=1e-6) == errors["stress"]
    assert errors["volumetric"] < 1e-12


def test_a_motion_without_contact_is_refused():
    with refused("frames"):
        visit(MODEL, hencky(), ball().state(V0), (0, 1), 10, 10, seed=0)


# ---- the table

TITLES = {"neuma": "NeuMA", "constants": "Constants"}
SCENES = {"a": "A", "b": "B", "c": "C"}


def errors(value, **changes):
    return dict.fromkeys([*PARTS, "asymmetric"], value) | {"true_rms": 2e3, "broken_paths": 0} | changes


def table(neuma, constants, paper=None, responses=None):
    content = {
        method: dict(zip(SCENES, values, strict=True))
        for method, values in (("neuma", neuma), ("constants", constants))
    }
    return stress_table(content, TITLES, SCENES, paper or PaperTable("", "Stresses", ""), responses)


def test_a_table_without_claims_has_no_verdicts():
    runs = [[errors(0.1)]] * 3
    _, markdown, verdicts = table(runs, runs)
    assert "What holds" not in markdown and "replicates" not in markdown and verdicts == []


@pytest.mark.parametrize(
    ("runs", "word"),
    [
        ([[0.1, 0.12, 0.11], [0.15, 0.15, 0.16], [0.9, 0.9, 0.9]], "holds"),
        ([[0.1, 0.12, 0.11], [0.15, 0.15, 0.25], [0.9, 0.9, 0.9]], "mixed"),  # 18 % +- 6 %
        ([[0.1], [0.15], [0.9]], "mixed"),
        ([[0.1, 0.1, 0.1], [0.21, 0.21, 0.21], [0.9, 0.9, 0.9]], "does not hold"),
    ],
)
def test_a_target_counts_scenes(runs, word):
    claim = Bound("within 20 % on 2", "constants", 20.0, count=2, quantity="stress")
    paper = PaperTable(claims=(claim,))
    replicates = [[errors(value) for value in values] for values in runs]
    _, markdown, (verdict,) = table(replicates, replicates, paper)
    assert verdict.word == word and f"| within 20 % on 2 | **{word}** |" in markdown


def response_of(inside, band=True):
    """A response with two tests, in the second of which so many of ten visited points are in the band."""
    x = list(range(10))
    results = {"x": x, "visited": [0, 9], "by_stress": False, "true": [1.0] * 10}
    bands = [{"x": x, "low": [0.0] * 10, "high": [2.0] * n + [0.5] * (10 - n)} for n in (10, inside)]
    return {name: results | ({"band": b} if band else {}) for name, b in zip("st", bands, strict=True)}


@pytest.mark.parametrize(
    ("last", "word"), [((10, 10, 10), "holds"), ((10, 10), "mixed"), ((10, 9, 10), "does not hold")]
)
def test_bands_are_scored_by_the_worst_test_of_every_replicate(last, word):
    (claim,) = [claim for claim in PAPER["stress"].claims if claim.quantity == OUTSIDE]
    claim = replace(claim, method="constants", count=3)
    runs = [[errors(0.1)] * len(last)] * 3
    whole = [[response_of(10)] * len(last)] * 2
    responses = {
        "neuma": dict.fromkeys(SCENES, [response_of(3, band=False)] * len(last)),
        "constants": dict(zip(SCENES, [*whole, [response_of(n) for n in last]], strict=True)),
    }
    text, _, (verdict,) = table(runs, runs, PaperTable(claims=(claim,)), responses)
    rows = {r["method"]: r for r in csv.DictReader(io.StringIO(text)) if r["quantity"] == "outside_band"}
    assert list(rows) == ["constants"], "a law without a band has no row"
    assert float(rows["constants"]["c"]) == pytest.approx(np.mean([100 - 10 * n for n in last]), abs=1e-4)
    assert verdict.word == word, verdict.here
    # The band is widest in the test whose truth lies in it everywhere.
    assert verdict.here.partition(", half width of the bands ")[2].startswith("100.0 ± < 0.1 %")


def test_half_widths_are_relative_to_the_visited_true_curve():
    curves = {
        "x": [0.0, 1.0, 2.0, 3.0],
        "visited": [1.0, 2.0],
        "by_stress": False,
        "true": [9.0, 3.0, 4.0, 9.0],
    }
    band = {"x": [0.0, 1.0, 2.0, 3.0], "low": [0.0, 2.0, 1.0, 0.0], "high": [9.0, 4.0, 7.0, 9.0]}
    assert half_width(curves | {"band": band}) == pytest.approx(math.sqrt((1**2 + 3**2) / (3**2 + 4**2)))
    assert half_width(curves | {"band": band, "visited": [1.2, 1.8]}) is None
    by_stress = curves | {"band": band, "by_stress": True, "visited": [3.5, 5.0]}
    assert half_width(by_stress) == pytest.approx(3 / 4)


def test_bounds_are_about_columns_of_their_tables_and_state_their_numbers():
    for name, paper in PAPER.items():
        for bound in (claim for claim in paper.claims if isinstance(claim, Bound)):
            assert set(bound.columns) <= set(paper.columns), name
            assert bound.count is None or 0 < bound.count <= len(bound.columns or paper.columns)
            assert {f"{bound.limit:g}", f"{bound.count or ''}"} <= {*bound.text.split(), ""}, bound.text


def test_percentages_are_of_root_mean_squares(elastic):
    """Against plain numpy."""
    errors = stress_errors(hencky(nu=0.2), hencky(), elastic, MODEL.dt)
    sigma = np.linalg.svd(elastic.F.numpy())[1]

    def principal(nu):
        mu, lam = lame(E, nu)
        eps = np.log(sigma)
        return 2 * mu * eps + lam * eps.sum(1, keepdims=True)

    true = principal(NU)
    expected = np.sqrt(((principal(0.2) - true) ** 2).sum() / (true**2).sum())
    assert errors["stress"] == pytest.approx(expected, rel=1e-5)
