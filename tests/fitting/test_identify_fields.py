"""Identification of a block whose stiffness changes along it, against candidates that are uniform."""

import math

import numpy as np
import pytest
import torch
import trimesh

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.laws import LawConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.fitting.families import Family
from neuma_lib.fitting.identified import FamilyFit
from neuma_lib.fitting.identify import identify, select_family
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.rollout import rollout
from neuma_lib.splatting.observation import Observation
from tests.support.grounding_scene import MODEL, block, camera
from tests.support.sim_scenes import law_spec as law

pytestmark = pytest.mark.core

FRAMES = tuple(range(0, 121, 8))
VELOCITY = (0.3, -1.5, 0.0)
GUESS = law("hencky", E=2e5)
FAMILIES = {
    "uniform": GUESS,
    "ramp": {**GUESS, "field": {"name": "ramp", "ratio": 1.0}},
    "halves": {**GUESS, "field": {"name": "halves", "ratio": 1.0, "boundary": 0.5}},
}


def identified(field, E=4e4, velocity=VELOCITY, seed=5, bodies=None):
    """The block filmed with noise, identified from a uniform guess.

    Args:
        bodies: the block with the particles of the truth, of the fit, and refined ones or None.
    """
    filmed, body, refined = bodies or (block(), block(), None)
    truth = law("hencky", E=E)
    with torch.no_grad():
        own = analytic_law({**truth, **({"field": field} if field else {})}, MODEL.dt)
        path = rollout(MODEL, own, filmed.state(velocity), steps=FRAMES[-1], frames=FRAMES, total=True)
        images = filmed.particle_gs(camera())(path.x, path.F_total)
    noise = torch.randn(images.shape, generator=torch.Generator().manual_seed(seed), dtype=images.dtype)
    centre = (body.mass @ body.x0 / body.mass.sum()).numpy()
    motion = InitialMotion(np.array(velocity), np.zeros(3), centre, np.eye(3), np.zeros(6))
    families = {name: LawConfig(**spec) for name, spec in FAMILIES.items()}
    settings = IdentifyConfig(families=families, pyramid=(4, 8, 32), pose_tolerance=0.0, refinement=1.0)
    video = Observation(FRAMES, images + 0.01 * noise, camera())
    return identify(MODEL, motion, body, video, settings, refined=[refined] if refined else [])


@pytest.mark.parametrize("ratio", [3.0, 0.3])
def test_a_ramp(ratio):
    result = identified({"name": "ramp", "ratio": ratio})
    assert result.best.family.name == "ramp" and "uniform" not in result.ties
    assert result.best.values["E"] == pytest.approx(4e4, rel=0.1)
    assert result.best.values["ratio"] == pytest.approx(ratio, rel=0.1)
    assert result.best.family.law_spec(result.best.values)["field"]["name"] == "ramp"


def test_two_halves():
    result = identified({"name": "halves", "ratio": 0.3, "boundary": 0.6})
    assert result.best.family.name == "halves" and "uniform" not in result.ties
    assert result.best.values["E"] == pytest.approx(4e4, rel=0.1)
    assert result.best.values["ratio"] == pytest.approx(0.3, rel=0.1)
    assert result.best.values["boundary"] == pytest.approx(0.6, abs=0.03)


def test_a_uniform_block_is_uniform():
    result = identified(None)
    assert result.best.family.name == "uniform"
    assert result.best.values["E"] == pytest.approx(4e4, rel=0.1)


def sampled(count, seed):
    """The block with other particles."""
    at = trimesh.transformations.translation_matrix([0.4, 0.08, 0.5])
    mesh = trimesh.creation.box([0.24, 0.12, 0.24], at)
    return block().resampled(torch.from_numpy(sample_volume(mesh, count, seed)), mesh.volume, 1000.0)


def test_few_particles_are_no_field():
    """The block of few particles fits better with a field. More particles do not agree with it, unless it is true."""
    for seed in (1, 2):
        few, many = sampled(300, seed), (sampled(1500, 100 + seed), sampled(1500, 200 + seed))
        assert identified(None, bodies=(many[0], few, None)).best.family.field
        result = identified(None, bodies=(many[0], few, many[1]))
        assert result.best.family.name == result.material.family.name == "uniform"
        assert result.material.values["E"] == pytest.approx(4e4, rel=0.1)
    ramp = {"name": "ramp", "ratio": 3.0}
    many = sampled(1500, 100), sampled(1500, 200)
    result = identified(ramp, bodies=(many[0], sampled(300, 0), many[1]))
    assert result.best.family.name == "ramp"
    values = result.material.values
    ends = values["E"], values["E"] * values["ratio"]
    assert ends == pytest.approx((4e4, 1.2e5), rel=0.2)


def test_a_field_must_be_better_than_the_uniform_family_by_more_than_a_tie():
    families = {name: Family(name, spec) for name, spec in FAMILIES.items()}

    def selected(**scores):
        fits = [
            FamilyFit(families[name], families[name].guess, score=score) for name, score in scores.items()
        ]
        best, ties = select_family(fits, IdentifyConfig(tie=0.15))
        return best.family.name, ties

    assert selected(uniform=1.0, ramp=0.9, halves=1.1) == ("uniform", ["ramp"])
    assert selected(uniform=1.0, ramp=0.8, halves=0.9) == ("ramp", ["halves"])
    assert selected(uniform=math.inf, ramp=0.9) == ("ramp", [])
    assert selected(uniform=1.0, ramp=math.inf) == ("uniform", [])


def test_limits_of_families_with_fields():
    uniform, ramp, halves = (Family(name, spec) for name, spec in FAMILIES.items())
    assert ramp.constants == ("E", "nu", "ratio") and not ramp.flows
    assert ramp.contains(uniform) and halves.contains(uniform)
    assert not halves.contains(ramp) and not uniform.contains(ramp)
    assert ramp.varies(uniform) and not ramp.varies(halves) and not uniform.varies(uniform)
    flow = Family("flow", {**law("hencky", "viscous_flow", viscosity=50), "field": FAMILIES["ramp"]["field"]})
    assert flow.contains(uniform) and not flow.varies(uniform)
    stiff = {"E": 1e12, "nu": 0.3}
    limits = [own.limited({**own.guess, **stiff}, MODEL, 1000.0)["E"] for own in (uniform, ramp)]
    assert limits[0] == limits[1]
    steep = ramp.limited({**stiff, "ratio": 4.0}, MODEL, 1000.0)["E"]
    assert steep == pytest.approx(limits[0] / 4)


@pytest.mark.slow
def test_random_blocks():
    """Ten random blocks each: the right family, ends within 15 %, the boundary within 0.1 of the length."""
    draw, right = np.random.default_rng(0), {name: [] for name in FAMILIES}
    for seed in range(10):
        ratio = math.exp(draw.uniform(math.log(1.8), math.log(5)) * (-1) ** seed)
        E = min(math.exp(draw.uniform(math.log(4e4), math.log(1e5))), 1e5 / max(ratio, 1))
        velocity, boundary = (draw.uniform(-0.8, 0.8), draw.uniform(-2, -1), 0.0), draw.uniform(0.3, 0.7)
        fields = {"ramp": {"ratio": ratio}, "halves": {"ratio": ratio, "boundary": boundary}}
        for name in FAMILIES:
            field = {"name": name, **fields[name]} if name in fields else None
            best = identified(field, E, velocity, seed).best
            ends = [E, E * ratio] if field else [E]
            fitted = [best.values["E"] * share for share in (1.0, best.values.get("ratio", 1.0))]
            close = all(abs(own / end - 1) < 0.15 for own, end in zip(fitted, ends, strict=False))
            placed = name != "halves" or abs(best.values.get("boundary", 0.0) - boundary) < 0.1
            right[name].append(best.family.name == name and close and placed)
    counts = {name: sum(met) for name, met in right.items()}
    assert counts["uniform"] >= 9 and counts["ramp"] >= 9 and counts["halves"] >= 8, counts
