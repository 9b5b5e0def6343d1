"""Identification of family and constants in videos with a known truth, and its uncertainty."""

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.laws import LawConfig
from neuma_lib.config.training import TrainingConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.errors import NonFiniteError
from neuma_lib.fitting import identify as identification
from neuma_lib.fitting.families import MAX_COURANT, Family
from neuma_lib.fitting.family_run import FamilyRun
from neuma_lib.fitting.frame_batches import check_contact, first_contact
from neuma_lib.fitting.identified import FamilyFit, Identified
from neuma_lib.fitting.identify import _better_later, _first_fit, _prune, identify, select_family
from neuma_lib.fitting.least_squares import (
    BLOCKS,
    Linearisation,
    block_sums,
    in_blocks,
    jackknife,
    laplace,
    levenberg_marquardt,
    secant_update,
)
from neuma_lib.fitting.video_residuals import Candidate, VideoResiduals, averaged, finer
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.files import write_json
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.catalogue import COURANT_LIMIT
from neuma_lib.mechanics.combinations import named_combinations, physical
from neuma_lib.methods.base import Problem
from neuma_lib.methods.spring_gaus.method import SpringGaus
from neuma_lib.methods.training import Training
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.colliders import Collider, contact_radius
from neuma_lib.sim.rigid_flight import rigid_flight
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from neuma_lib.splatting.observation import Observation
from neuma_lib.threads import use_threads
from tests.support import grounding_scene
from tests.support.errors import refused
from tests.support.grounding_scene import MODEL, RADIUS, camera, observe
from tests.support.sim_scenes import law_spec as law

pytestmark = pytest.mark.core

HEIGHT = 0.27
"""Of the ball's centre, so that it rests on the floor long enough for three held-out frames."""
ball = partial(grounding_scene.ball, height=HEIGHT)
V0 = (0.5, -1.5, 0.0)
FRAMES = tuple(range(0, 121, 8))
SQUARES = (4, 8, 32)
DENSITY = 1000.0

ELASTIC = law("hencky")
PLASTIC = law("hencky", "von_mises", yield_stress=4e3)
FLUID = law("hencky", "viscous_flow", viscosity=60)


def settings(families: dict, **options) -> IdentifyConfig:
    families = {name: LawConfig(**spec) for name, spec in families.items()}
    return IdentifyConfig(families=families, **{"pyramid": SQUARES, "pose_tolerance": 0.0, **options})


def pixel_noise(images: torch.Tensor) -> torch.Tensor:
    return 0.01 * torch.randn(images.shape, generator=torch.Generator().manual_seed(5), dtype=images.dtype)


def known(body, std=(0.0,) * 6, v0=V0) -> InitialMotion:
    """The true initial motion, up to standard deviations."""
    centre = (body.mass @ body.x0 / body.mass.sum()).numpy()
    return InitialMotion(np.array(v0), np.zeros(3), centre, np.eye(3), np.array(std))


def identified_in(spec: dict, families: dict, noise=pixel_noise, motion=None, **options):
    """What is identified in a noisy video of the ball under a law."""
    body, seen = video_of(spec, V0, FRAMES, noise)
    other_videos = options.pop("other_videos", ())
    chosen = settings(families, covariance_from="elastic", **options)
    return identify(MODEL, motion or known(body), body, seen, chosen, other_videos=other_videos)


def video_of(spec: dict, v0, frames, noise=pixel_noise):
    """The ball, and a noisy video of it under a law."""
    body = ball()
    seen = observe(body, v0, frames, spec)
    return body, Observation(seen.frames, seen.images + noise(seen.images), seen.cameras)


def test_constants_and_family_of_the_truth_are_identified():
    """The truth among the candidates, with one that contains it: constants to 3 %, from four times too stiff."""
    families = {"von_mises": PLASTIC, "hencky": ELASTIC}
    truth = law("hencky", E=1.5e4, nu=0.35)
    identified = identified_in(truth, families)
    assert identified.best.family.name == "hencky" and identified.ties == []
    assert identified.best.values["E"] == pytest.approx(1.5e4, rel=0.03)
    assert identified.best.values["nu"] == pytest.approx(0.35, abs=0.02)
    assert identified.frames[0] + identified.held_out[0] == FRAMES and len(identified.held_out[0]) == 3
    assert identified.as_dict()["law"]["plasticity"] == {"name": "identity"}


@pytest.mark.parametrize("true", ["kelvin_voigt", "maxwell"])
def test_a_viscous_part_is_identified(true):
    """With its constants, among an elastic solid, a fluid and the other viscous part."""
    constants = {
        "kelvin_voigt": ({"viscosity": 60.0}, {"viscosity": 20.0}),
        "maxwell": ({"modulus": 1e4, "relaxation": 0.02}, {"modulus": 5e3, "relaxation": 0.05}),
    }
    families = {"hencky": ELASTIC, "fluid": FLUID}
    for name, (_, guess) in constants.items():
        families[name] = {"elasticity": ELASTIC["elasticity"], "viscosity": {"name": name, **guess}}
    truth, own = {"elasticity": {"name": "hencky", "E": 1.5e4, "nu": 0.35}}, constants[true][0]
    identified = identified_in(truth | {"viscosity": {"name": true, **own}}, families)
    assert identified.best.family.name == true and identified.ties == []
    expected = {"E": 1.5e4, "nu": 0.35, **own}
    assert identified.best.values == pytest.approx(expected, rel=0.03)


def test_held_out_frames_select_the_family():
    """The first frames are of one family, and fit it better. The last frames are those that the fit of the other one
    predicts, which is therefore selected. Fits to the first frames do not depend on the last ones."""
    families = {"hencky": ELASTIC, "neo_hookean": law("neo_hookean")}
    options = settings(families, covariance_from="elastic", pyramid=(8, 32), prune_factor=1e30)
    truth = law("hencky", E=1.5e4, nu=0.35)
    body, seen = video_of(truth, V0, FRAMES, torch.zeros_like)
    first = identify(MODEL, known(body), body, seen, options)
    assert first.best.family.name == "hencky"
    values, fitted = first.fits["neo_hookean"].values, len(first.frames[0])
    _, later = video_of(law("neo_hookean", **values), V0, FRAMES, torch.zeros_like)
    images = torch.cat([seen.images[:fitted], later.images[fitted:]])
    second = identify(MODEL, known(body), body, replace(seen, images=images), options)
    assert second.best.family.name == "neo_hookean"
    for name, fit in second.fits.items():
        assert fit.values == first.fits[name].values and fit.loss == first.fits[name].loss
        penalised = math.log(max(fit.held_out, 1e-12)) + options.penalty * len(fit.values)
        assert fit.score == pytest.approx(penalised, rel=1e-12)
    assert second.fits["hencky"].loss < second.fits["neo_hookean"].loss


def test_the_last_fit_does_not_start_from_misleading_first_frames(monkeypatch):
    """All frames are fitted at all levels, also from guesses, if the last ones are predicted far worse, as those of a
    plastic body by an elastic one."""
    calls, begin = [], FamilyRun.begin

    def recorded(run, starts, level=0, *args, **options):
        calls.append((len(starts), level))
        begin(run, starts, level, *args, **options)

    monkeypatch.setattr(FamilyRun, "begin", recorded)
    truth = law("hencky", "von_mises", E=6e4, nu=0.3, yield_stress=2e3)
    for factor, expected in ((1e6, (1, len(SQUARES) - 1)), (1.2, (3, 0))):
        assert identified_in(truth, {"hencky": ELASTIC}, prune_factor=factor).best.refined
        assert calls[-1] == expected


def test_an_uncertain_motion_is_corrected_and_widens_the_constants():
    """A velocity with an error of one standard deviation along all axes is corrected to a third of that.

    The constants are as accurate as with the true velocity, and receive the remaining uncertainty. The noise is one
    level of 8 bits: the standard deviation of the depth that it leaves, 0.008 m/s, is below a third of the error.
    """

    def noise(images):
        return pixel_noise(images) / 2.55

    truth, families = law("hencky", E=3e4, nu=0.35), {"hencky": ELASTIC}
    off, std = np.array([0.03, -0.03, 0.06]), (0.03, 0.03, 0.06, 0.2, 0.2, 0.2)
    motion = known(ball(), std)
    result = identified_in(truth, families, noise, replace(motion, velocity=motion.velocity + off)).best
    assert (np.abs(result.motions[0].velocity - V0) < np.abs(off) / 3).all()
    assert (np.abs(result.motions[0].spin) < 0.2).all()
    assert (result.motions[0].std < std).all() and (result.motions[0].std > 0).all()
    assert result.values["E"] == pytest.approx(3e4, rel=0.04)
    sure = identified_in(truth, families, noise).best
    assert (np.diag(result.covariance) > np.diag(sure.covariance)).all()
    assert sure.motions[0].std.max() == 0 and sure.as_dict(settings(families))["start"]["v0"] == list(V0)


def test_two_videos_have_the_constants_in_common_and_a_motion_each():
    """A faster and uncertain motion with fewer frames in addition to the ordinary one: both motions and the constants
    are estimated, and the bulk modulus, which the first video determines least, with less uncertainty."""
    families, truth = {"hencky": ELASTIC}, law("hencky", E=3e4, nu=0.4)
    v0, off = (0.2, -2.5, 0.3), np.array([0.03, 0.05, 0.0])
    body, seen = video_of(truth, v0, FRAMES[:11])
    motion = known(body, (0.05, 0.05, 0.0, 0.0, 0.0, 0.0), np.array(v0) + off)
    options = dict(pyramid=(8, 32))
    alone = identified_in(truth, families, **options)
    both = identified_in(truth, families, other_videos=[(motion, body, seen)], **options)
    assert both.best.values["E"] == pytest.approx(3e4, rel=0.02)
    assert both.best.values["nu"] == pytest.approx(0.4, abs=0.02)
    first, second = both.best.motions
    assert (first.velocity == V0).all() and first.std.max() == 0
    assert (np.abs(second.velocity - v0) < np.abs(off) / 3 + 1e-12).all() and (second.std[:2] < 0.05).all()
    stds = [
        {name: std for name, _, std in result.best.quantities(result.settings)} for result in (alone, both)
    ]
    assert stds[1]["K"] < stds[0]["K"]
    written = both.as_dict()
    assert written["start"]["v0"] == list(V0) and len(written["further_videos"]) == 1
    assert "further_videos" not in alone.as_dict()


def test_videos_have_their_own_colliders_and_clamps():
    """A press and a hang: the true stiffness, and images that the obstacles of the other video do not explain."""
    families, truth = {"hencky": ELASTIC}, law("hencky", E=3e4, nu=0.4)
    still, poses = (0.0, 0.0, 0.0), ((0.0, 0.5), (0.12, 0.3), (0.24, 0.5))
    platen = Collider("box", (0.2, 0.02, 0.2), keyframes=tuple((t, (0.5, y, 0.5), still) for t, y in poses))
    clamp = Clamp((0.3, 0.32, 0.3), (0.7, 0.5, 0.7), release=0.15)
    models = [replace(MODEL, colliders=(platen,)), replace(MODEL, clamps=(clamp,))]
    videos = []
    for model in models:
        body = ball()
        seen = observe(body, still, FRAMES, truth, model)
        seen = Observation(seen.frames, seen.images + pixel_noise(seen.images), seen.cameras)
        videos.append((known(body, v0=still), body, seen))
    chosen = settings(families, covariance_from="elastic", pyramid=(8, 32))
    own, swapped = (
        identify(each, *videos[0], chosen, other_videos=videos[1:]).best for each in (models, models[::-1])
    )
    assert own.values["E"] == pytest.approx(3e4, rel=0.03)
    assert swapped.loss > 10 * own.loss
    with refused("model"):
        identify([*models, MODEL], *videos[0], chosen, other_videos=videos[1:])


def test_a_joint_fit_starts_from_that_to_the_first_video(monkeypatch):
    """From its constants at the last level."""
    begun, begin = [], FamilyRun.begin

    def recorded(run, starts, *args, **options):
        begin(run, starts, *args, **options)
        begun.append((run, list(starts)))

    monkeypatch.setattr(FamilyRun, "begin", recorded)
    body, seen = video_of(ELASTIC, V0, FRAMES[:11])
    others = [(known(body), body, seen)]
    options = dict(pyramid=(8, 32), start_from_first_video=True)
    identified_in(ELASTIC, {"hencky": ELASTIC}, other_videos=others, **options)
    (alone, _), (both, starts), *_ = begun
    assert (len(alone.videos), len(both.videos)) == (1, 2) and alone.refined and alone.values in starts
    begun.clear()
    identified_in(ELASTIC, {"hencky": ELASTIC}, other_videos=others, pyramid=(8, 32))
    assert all(len(run.videos) == 2 for run, _ in begun)


def test_videos_count_alike_however_long():
    """The same video again, in half as many frames: the loss is the mean of both, the estimate is the same."""
    families, truth = {"hencky": ELASTIC}, law("hencky", E=3e4, nu=0.4)
    options = dict(pyramid=(8, 32), frames=33)
    body, half = video_of(truth, V0, FRAMES[::2])
    results = [
        identified_in(truth, families, **options),
        identify(MODEL, known(body), body, half, settings(families, covariance_from="elastic", **options)),
        identified_in(truth, families, other_videos=[(known(body), body, half)], **options),
    ]
    held_out = [one.fits["hencky"].held_out for one in results]
    assert held_out[2] == pytest.approx((held_out[0] + held_out[1]) / 2, rel=0.02)
    losses = [one.fits["hencky"].loss for one in results]
    assert losses[2] == pytest.approx((losses[0] + losses[1]) / 2, rel=0.02)


def test_two_grids_give_the_constants_of_the_material():
    """The video is of a body of many particles on a grid three times as fine as that of the fit.

    Constants of the material are closer to the truth than those of the coarse grid, which the second grid hardly
    changes. The coarse grid hides a large error of nu behind a small one of E.
    """
    truth, families = law("hencky", E=3e4, nu=0.35), {"hencky": ELASTIC}
    body = ball()
    centre, volume = torch.tensor([0.5, HEIGHT, 0.5], dtype=torch.float64), 4 / 3 * math.pi * RADIUS**3

    def filled(count):
        """A lattice whose particles, of the radius of contact, end at the surface."""
        spacing = (volume / count) ** (1 / 3)
        ticks = torch.arange(-RADIUS, RADIUS, spacing, dtype=torch.float64)
        x = torch.cartesian_prod(ticks, ticks, ticks)
        return body.resampled(centre + x[x.norm(dim=1) < RADIUS - spacing / 2], volume, 1000.0)

    coarse = replace(MODEL, grid=24)
    few, many = filled(1000), filled(16000)
    assert len(many.x0) > 10000 and float(many.mass.sum()) == pytest.approx(float(few.mass.sum()))
    finest = replace(coarse, grid=72, dt=MODEL.dt / 3)
    path = rollout(
        finest,
        analytic_law(truth, finest.dt),
        known(many).of_body(many),
        steps=3 * FRAMES[-1],
        frames=[3 * n for n in FRAMES],
    )
    cameras = camera(32, few.x0.dtype)
    seen = Observation(FRAMES, many.particle_gs(cameras)(path.x, path.F), cameras)
    options = settings(families, covariance_from="elastic", refinement=2)
    one = identify(coarse, known(few), few, seen, options)
    two = identify(coarse, known(few), few, seen, options, refined=[filled(6000)])
    error = {
        name: abs(math.log(fit.values["E"] / 3e4)) + abs(fit.values["nu"] - 0.35)
        for name, fit in (("alone", one.best), ("grid", two.best), ("material", two.material))
    }
    assert one.material is None and error["material"] < error["grid"] / 2
    assert two.best.values["E"] == pytest.approx(one.best.values["E"], rel=0.05)
    written = two.as_dict()
    assert written["grid"] == 24 and written["law"] != written["material"]["law"]
    assert "of the material" in written["says"]


def test_more_particles_give_the_constants_of_the_material_on_a_shared_grid():
    """Few particles of the body appear as another material, which predicts their motion best."""
    truth, body = law("hencky", E=3e4, nu=0.35), ball()
    mesh = trimesh.creation.icosphere(4, RADIUS).apply_translation([0.5, HEIGHT, 0.5])

    def filled(count, seed):
        return body.resampled(torch.from_numpy(sample_volume(mesh, count, seed)), mesh.volume, 1000.0)

    few, many, true = filled(120, 1), filled(2000, 2), filled(2000, 3)
    path = rollout(
        MODEL, analytic_law(truth, MODEL.dt), known(true).of_body(true), steps=FRAMES[-1], frames=FRAMES
    )
    cameras = camera(32, few.x0.dtype)
    seen = Observation(FRAMES, true.particle_gs(cameras)(path.x, path.F), cameras)
    options = settings({"hencky": ELASTIC}, covariance_from="elastic", refinement=1)
    alone = identify(MODEL, known(few), few, seen, options)
    result = identify(MODEL, known(few), few, seen, options, refined=[many])
    error = {
        name: abs(math.log(fit.values["E"] / 3e4)) + abs(fit.values["nu"] - 0.35)
        for name, fit in (("grid", result.best), ("material", result.material))
    }
    assert result.best.values == alone.best.values and result.fits.keys() == {"hencky"}
    assert error["material"] < error["grid"] / 2


def test_the_finer_grid_decides_between_families_of_similar_scores(monkeypatch):
    """Scores are given: on the grid of the model hencky is best, neo_hookean close and fixed_corotated far."""
    coarse = {"hencky": -8.0, "neo_hookean": -7.5, "stvk": -7.0, "fixed_corotated": -6.0}
    fine = {"hencky": -8.0, "neo_hookean": -9.0, "stvk": -8.5}
    compared, scored = [], FamilyRun.score

    def score(run):
        name, fit = run.family.name, scored(run)
        if run.counts[0] < len(FRAMES):  # held-out frames remain
            fit.score = (fine if run._fine else coarse)[name]
            fit.held_out = math.exp(fit.score)
            compared.extend([name] if run._fine else [])
        return fit

    monkeypatch.setattr(FamilyRun, "score", score)
    body, seen = video_of(ELASTIC, V0, FRAMES)
    names = {
        "hencky": ELASTIC,
        "fixed_corotated": law("fixed_corotated"),
        "neo_hookean": law("neo_hookean"),
        "stvk": law("stvk"),
    }
    options = settings(names, covariance_from="elastic", pyramid=(4, 8), prune_factor=math.exp(1.9), tie=0.6)
    result = identify(MODEL, known(body), body, seen, options, refined=[body])
    assert sorted(compared) == ["hencky", "neo_hookean", "stvk"]
    assert result.best.family.name == "neo_hookean" and result.ties == ["stvk"]
    assert result.material.family.name == "neo_hookean"
    assert result.fits["hencky"].score == fine["hencky"] and result.fits["fixed_corotated"].score == -6.0
    alone = identify(MODEL, known(body), body, seen, options)
    assert alone.best.family.name == "hencky" and alone.material is None

    begin = FamilyRun.begin
    monkeypatch.setattr(
        FamilyRun, "begin", lambda run, *given, **options: run._fine or begin(run, *given, **options)
    )
    messages = []
    coarse_only = identify(MODEL, known(body), body, seen, options, refined=[body], log=messages.append)
    assert coarse_only.best.family.name == "hencky" and coarse_only.material is None
    dropped = [text for text in messages if "no constants of the material" in text]
    assert len(dropped) == 1 and dropped[0].startswith("hencky: ")
    identify(MODEL, known(body), body, seen, options, log=messages.append)
    assert len([text for text in messages if "no constants of the material" in text]) == 1, "not asked for"


@pytest.mark.parametrize(
    "steps, substeps", [((0, 8, 16, 24), 12 / 8), ((0, 7, 14), 11 / 7), ((0, 1, 4), 2.0)]
)
def test_steps_of_the_model_are_whole_steps_of_the_finer_grid(steps, substeps):
    """The time step is divided by at least as much as the spacing of the nodes."""
    fine = finer(MODEL, 1.5, steps)
    assert fine.grid == 24 and MODEL.dt / fine.dt == pytest.approx(substeps, rel=1e-12)
    assert all(abs(n * MODEL.dt / fine.dt - round(n * MODEL.dt / fine.dt)) < 1e-9 for n in steps)


@pytest.mark.parametrize("refinement", [1.5, 2])
def test_an_extrapolation_covers_both_orders_of_convergence(refinement):
    """Errors of log E that are proportional to dx^2 vanish, those that are proportional to dx are one standard
    deviation."""
    family = Family("hencky", ELASTIC)

    def fit(log_error, covariance=None):
        return FamilyFit(family, {"E": 1e5 * math.exp(log_error), "nu": 0.3}, covariance=covariance)

    for order, deviations in ((1, 1.0), (2, 0.0)):
        fine = fit(0.1 / refinement**order, 1e-6 * np.eye(2)).extrapolated(fit(0.1), refinement, 4)
        error, std = math.log(fine.values["E"] / 1e5), math.sqrt(fine.covariance[0, 0] - 1e-6)
        assert abs(error) == pytest.approx(deviations * std, rel=1e-6, abs=1e-9) and std > 1e-3
        assert fine.values["nu"] == pytest.approx(0.3) and fine.covariance[1, 1] == pytest.approx(1e-6)
    vague = np.array([[0.5, 1e-5], [1e-5, 1e-8]])
    joined = fit(0.0, 1e-6 * np.eye(2)).extrapolated(fit(0.0, vague), refinement, 4).covariance
    assert all(np.linalg.eigvalsh(joined - each).min() > -1e-12 for each in (vague, 1e-6 * np.eye(2)))
    assert np.trace(joined) < np.trace(vague) + 3e-6, "the larger of both, not their sum"
    far = fit(-math.log(9), 1e-6 * np.eye(2)).extrapolated(fit(0.0), refinement, 4)
    limited = -math.log(9) - math.log(2) / (refinement**2 - 1)
    assert math.log(far.values["E"] / 1e5) == pytest.approx(limited)
    assert far.covariance[0, 0] > 0.5 * (math.log(9) / refinement) ** 2


def test_more_particles_on_the_same_grid_are_not_extrapolated():
    """The remaining error, if it is proportional to the inverse of the number, is one standard deviation."""
    family = Family("hencky", ELASTIC)

    def fit(count):
        values = {"E": 1e5 * math.exp(0.4 * 1000 / count), "nu": 0.3}
        return FamilyFit(family, values, covariance=1e-6 * np.eye(2))

    material = fit(4000).extrapolated(fit(1000), 1.0, 4)
    assert material.values == pytest.approx(fit(4000).values)
    assert math.sqrt(material.covariance[0, 0] - 1e-6) == pytest.approx(0.1)


def test_a_constant_at_its_bound_leaves_uncertain_what_depends_on_it():
    """Poisson's ratio next to 0, where its logit is uncertain by 5, may be up to 0.11: the moduli from draws."""
    family, std = Family("hencky", ELASTIC), 5.0
    fit = FamilyFit(family, {"E": 1e5, "nu": 0.001}, covariance=np.diag([1e-6, std**2]))
    names, covariance = fit.log_covariance(physical)
    u = family.unbounded(fit.values)
    draws = [family.bounded(u + [0, std * z]) for z in np.random.default_rng(0).standard_normal(20_000)]
    for name, variance in zip(names, np.diag(covariance), strict=True):
        low, high = np.quantile([math.log(physical(values)[name]) for values in draws], [0.159, 0.841])
        assert math.sqrt(variance) > 0.04 and math.sqrt(variance) == pytest.approx((high - low) / 2, rel=0.1)
    sure = FamilyFit(family, {"E": 1e5, "nu": 0.3}, covariance=1e-6 * np.eye(2))
    E, G, K = (
        sure.log_covariance(lambda v, key=key: {key: {**v, **physical(v)}[key]})[1][0, 0] for key in "EGK"
    )
    slope = 0.3 * (1 - 0.3 / 0.5)  # of nu by its logit
    assert E == pytest.approx(1e-6) and G == pytest.approx(1e-6 * (1 + (slope / 1.3) ** 2), rel=1e-4)
    assert K == pytest.approx(1e-6 * (1 + (2 * slope / 0.4) ** 2), rel=1e-4)


def test_a_motion_is_read_moved_and_written():
    """Deviations along the camera's axes are those of the world turned; what is known does not move."""
    axes = [[0, 0, 1], [0, -1, 0], [1, 0, 0]]
    content = {"v0": [1, 2, 3], "angular_velocity": [0, 1, 0], "centre": [0.5, 0.5, 0.5], "camera_axes": axes}
    motion = InitialMotion.of(
        content | {"std_camera": [0.1, 0.2, 0.3], "angular_velocity_std_camera": [1, 0, 0]}
    )
    moved = motion.moved(np.array([1.0, 2.0, 0.0, 1.0, 5.0, 5.0]))
    np.testing.assert_allclose(moved.velocity, [1, 1.6, 3.1])
    np.testing.assert_allclose(moved.spin, [0, 1, 1])
    again = InitialMotion.of(moved.as_dict())
    assert all(np.array_equal(getattr(again, field), getattr(moved, field)) for field in vars(moved))
    assert not InitialMotion.of(content).std.any()
    body = ball()
    around = np.cross(moved.spin, body.x0.numpy() - moved.centre)
    np.testing.assert_allclose(moved.of_body(body).v, moved.velocity + around)


class FakeRun:
    """The attributes of a fit that `_prune` reads: squared residuals, family, and an image."""

    alive = True

    def __init__(self, cost, spec, picture):
        self.fit = Linearisation(np.zeros(0), np.zeros(0), cost, 0.0)
        self.family, self.picture = Family("x", spec), picture

    def resembles(self, other):
        return self.picture == other.picture


def test_families_with_a_high_cost_and_redundant_ones_are_pruned():
    """Families that are merely no better in blurred images are kept, with more constants, of another elasticity, or
    with flow that a contained soft body also reproduces."""
    options = settings({"hencky": ELASTIC}, prune_factor=3.0)
    elastic, far = FakeRun(1.0, ELASTIC, "soft"), FakeRun(3.1, law("neo_hookean"), "far")
    never_yields, flat = FakeRun(0.99, PLASTIC, "soft"), FakeRun(1.2, FLUID, "flat")
    sibling = FakeRun(1.0, law("fixed_corotated"), "soft")
    runs = [elastic, far, never_yields, flat, sibling]
    _prune(runs, options, keep_redundant=True)
    assert [run.alive for run in runs] == [True, False, True, True, True]
    _prune(runs, options)
    assert [run.alive for run in runs] == [True, False, False, True, True]
    grains = FakeRun(1.0, law("hencky", "drucker_prager", friction_angle=30), "soft")
    _prune([elastic, grains], options)
    assert grains.alive, "sand does not contain the elastic body"
    clay, stiffer = FakeRun(2.9, PLASTIC, "clay"), FakeRun(8.8, PLASTIC, "stiffer")
    mud = FakeRun(9.1, law("hencky", "viscous_flow", viscosity=50), "mud")
    _prune([elastic, clay, stiffer, mud], options)
    assert elastic.alive and clay.alive and not stiffer.alive, (
        "return maps are compared by the square of the factor"
    )
    assert not mud.alive
    uneven = FakeRun(0.2, {**ELASTIC, "field": {"name": "ramp", "ratio": 1.0}}, "uneven")
    _prune([elastic, sibling, uneven], options)
    assert elastic.alive and not sibling.alive, "the uniform family of a field is kept, no other"


def test_fits_restart_from_better_ones_that_started_later():
    """From the best of all, and the best one with the same constants, since a flow may lead with constants that suit no
    elastic body."""
    stuck, elastic = FakeRun(9.0, ELASTIC, "stuck"), FakeRun(2.0, law("fixed_corotated"), "soft")
    worse, flow = FakeRun(3.0, law("neo_hookean"), "soft"), FakeRun(1.0, PLASTIC, "flows")
    pairs = _better_later([stuck, elastic, worse, flow])
    assert pairs == [(stuck, flow), (stuck, elastic), (elastic, flow), (worse, flow)]
    stuck.alive = flow.alive = False
    assert _better_later([stuck, elastic, worse, flow]) == []


def test_a_fit_restarts_from_the_best_constants_if_they_are_better():
    """A flow that starts beyond its yield stress never yields: a local minimum that other limits leave."""
    body, seen = video_of(PLASTIC, V0, FRAMES)
    chosen = settings({"plastic": PLASTIC}, covariance_from="elastic", refined_particles=0, iterations=3)
    video, family = VideoResiduals(MODEL, known(body), body, seen, chosen), Family("plastic", PLASTIC)
    stuck = family.with_guesses({"yield_stress": 1e6})
    run = FamilyRun(family, [video], [len(FRAMES)], chosen)
    run.begin([stuck])
    before = run.fit.cost
    run.restart_from([stuck, *family.with_other_limits(stuck, (1, 2))])
    assert run.fit.cost == before, "no start is better"
    run.restart_from([stuck, *family.with_other_limits(stuck, (-4, -2))])
    assert run.fit.cost < 0.5 * before and run.values["yield_stress"] < 1e5


def test_a_flow_that_never_yields_shows_the_elastic_body():
    """And one that yields does not, whatever their squared residuals."""
    body, seen = video_of(ELASTIC, V0, FRAMES)
    chosen = settings({"hencky": ELASTIC}, covariance_from="elastic", refined_particles=0)
    video = VideoResiduals(MODEL, known(body), body, seen, chosen)
    runs = [
        FamilyRun(Family("x", spec), [video], [len(FRAMES)], chosen) for spec in (ELASTIC, PLASTIC, PLASTIC)
    ]
    for run, limit in zip(runs, (1.0, 1e5, 1e3), strict=True):
        values = run.family.with_guesses({"yield_stress": limit})
        run._origin = run.family.unbounded(values)
        run.fit = Linearisation(np.zeros(0), np.zeros(0), run.cost(run._u), 0.0)
    elastic, never_yields, yields = runs
    assert never_yields.resembles(elastic) and not yields.resembles(elastic)


def test_number_of_threads_changes_no_bit_of_the_residuals():
    """And of the derivatives by the initial motion and the position of the rendered body."""
    body, seen = video_of(ELASTIC, V0, FRAMES)
    chosen = settings(
        {"hencky": ELASTIC}, covariance_from="elastic", refined_particles=0, pose_tolerance=0.01
    )
    candidates = [Candidate(law("hencky", E=E), np.zeros(9)) for E in (3e4, 1e5, 3e5)]
    results = []
    for count in (1, 2, 3):
        use_threads(count)
        try:
            video = VideoResiduals(MODEL, known(body, (0.1,) * 6), body, seen, chosen)
            video.differentiate(candidates[0])
            values = [*video.residuals(candidates, len(FRAMES)), *video.by_deviation]
        finally:
            use_threads(1)
        results.append([residual for each in values for residual in each])
    assert len(results[0]) == len(candidates) + 9 and results[0][-1].abs().max() > 0
    for other in results[1:]:
        assert all(map(torch.equal, results[0], other))


def test_rigid_flight_is_not_simulated(monkeypatch):
    """Frames before the contact of a stiff spinning ball have the same images for all laws, and the residuals of all
    frames are those of a full simulation, within a tenth of the effect of a difference of E."""
    body, seen = video_of(law("hencky", E=4e5), V0, FRAMES, noise=torch.zeros_like)
    chosen = settings({"hencky": ELASTIC}, covariance_from="elastic", refined_particles=0)
    motion = replace(known(body), spin=np.array([3.0, 1.0, -2.0]))
    one, other = (Candidate(law("hencky", E=E), np.zeros(9)) for E in (4e5, 4.16e5))

    def residuals():
        video = VideoResiduals(MODEL, motion, body, seen, chosen)
        return [each[0] for each in video.residuals([one, other], len(FRAMES))]

    (flown, varied), start = residuals(), motion.of_body(body)
    contact = first_contact(MODEL, rigid_flight(MODEL, start, FRAMES).x, body.vol0, FRAMES)
    assert 2 < contact < len(FRAMES) and torch.equal(flown[:contact], varied[:contact])
    monkeypatch.setattr("neuma_lib.fitting.video_residuals.is_rigid", lambda *given: False)
    simulated, _ = residuals()
    assert 0 < (flown - simulated).norm() < 0.1 * (varied - flown).norm()


def test_frames_after_the_contact_decide():
    """However late the contact is: a share of what follows it, and the others are fitted."""
    body, seen = video_of(ELASTIC, V0, FRAMES)
    for v0, share in ((V0, 0.25), ((0.5, -0.6, 0.0), 0.25), (V0, 0.5)):
        chosen = settings({"hencky": ELASTIC}, covariance_from="elastic", refined_particles=0)
        video = VideoResiduals(MODEL, known(body, v0=v0), body, seen, chosen)
        video.hold_out(Family("hencky", ELASTIC), share)
        path = rollout(MODEL, analytic_law(ELASTIC), body.state(v0), steps=FRAMES[-1], frames=FRAMES)
        informative = len(FRAMES) - first_contact(MODEL, path.x, body.vol0)
        assert 0 < informative < len(FRAMES)
        assert len(FRAMES) - video.fitted == round(share * informative)


def test_what_parts_of_the_video_and_tied_families_disagree_about_is_uncertain():
    """The change since the fit to the first frames, and the scatter of shared constants over families that are as good,
    are uncertain; what is not shared is not."""
    family, other = Family("plastic", PLASTIC), Family("elastic", law("neo_hookean"))
    values = {"E": 6e4, "nu": 0.3, "yield_stress": 4e3}
    first = FamilyFit(family, {**values, "E": 5e4})
    fit = FamilyFit(family, values)
    alone = fit.disagreement(first, [])
    np.testing.assert_allclose(np.sqrt(np.diag(alone)), [math.log(6 / 5), 0, 0], atol=1e-12)
    tied = alone + fit.disagreement(fit, [FamilyFit(other, {"E": 12e4, "nu": 0.3})])
    expected = [math.hypot(math.log(6 / 5), math.log(2) / math.sqrt(2)), 0, 0]
    np.testing.assert_allclose(np.sqrt(np.diag(tied)), expected, atol=1e-12)


@pytest.mark.parametrize("flat", [1.0, 4.0, math.inf])
def test_a_plateau_widens_what_is_not_determined(flat):
    """Squared residuals that rise so many times less on one side than their quadratic: so much larger is the variance,
    up to that of the spread. A determined axis costs no simulation."""
    chosen, curvature = settings({"hencky": ELASTIC}, spread=2.0, determined=0.1), np.diag([1e4, 5.0])
    run = FamilyRun(Family("hencky", ELASTIC), [SimpleNamespace(deviations=9)], [0], chosen)
    run.fit, tried = Linearisation(np.pad(curvature, (0, 9))[None], np.zeros((1, 11)), 1.0, 1.0), []
    run._covariance = lambda: np.diag([1e-4, 0.25] + [0.0] * 9)

    def cost(u):
        tried.append(u)
        return 1.0 + u @ run.fit.curvature @ u / (flat if u[1] > 0 else 1.0)

    run._simulate, run._cost = lambda points: points, cost
    added = run.covariance_of_plateaus()
    np.testing.assert_allclose(added, np.diag([0.0, min(0.25 * flat, 4.0) - 0.25]), atol=1e-9)
    assert len(tried) == 2 and all(abs(u[1]) == pytest.approx(1.0) for u in tried)


@pytest.mark.parametrize("level", [False, True])
def test_a_fit_that_ends_before_the_minimum_of_a_quadratic_is_on_no_plateau(level):
    """It is 0.8 of the step away, where the cost on one side is hardly higher. Above the slope it is the quadratic."""
    chosen = settings({"hencky": ELASTIC}, spread=2.0, determined=0.1, level_plateaus=level)
    run = FamilyRun(Family("hencky", ELASTIC), [SimpleNamespace(deviations=9)], [0], chosen)
    H, away = np.pad(np.diag([1e4, 5.0]), (0, 9)), np.eye(11)[1] * 0.4
    run.fit = Linearisation(H[None], np.zeros((1, 11)), away @ H @ away, 1.0)
    run._covariance = lambda: np.diag([1e-4, 0.25] + [0.0] * 9)
    run._simulate, run._cost = lambda points: points, lambda u: (u - away) @ H @ (u - away)
    added = run.covariance_of_plateaus()
    # The step is 1: (1 - 0.4)^2 - 0.4^2 = 0.2 of the quadratic.
    np.testing.assert_allclose(added, np.diag([0.0, 0.0 if level else 0.25 / 0.2 - 0.25]), atol=1e-9)


def test_a_plastic_body_is_no_elastic_one_and_is_pictured(tmp_path):
    truth = law("hencky", "von_mises", E=6e4, nu=0.3, yield_stress=2e3)
    identified = identified_in(truth, {"hencky": ELASTIC, "von_mises": PLASTIC})
    assert identified.best.family.name == "von_mises" and "hencky" not in identified.ties
    assert identified.best.values["yield_stress"] == pytest.approx(2e3, rel=0.03)
    content = identified.as_dict()
    write_json(tmp_path / "identified.json", content)  # refuses what is no number
    quantities = content["best"]["quantities"]
    assert quantities["yield_stress"]["determined"] and "yield_stress" in content["says"]
    pytest.importorskip("matplotlib")
    from neuma_lib.paper.identified_page import identified_page

    figure = identified_page(content, truth)
    assert len(figure.axes) == 2 and len(figure.axes[1].get_yticklabels()) == len(quantities)


def test_uncertainty_covers_the_error_of_patches_that_last():
    """Patches of 8 px that stay over all frames, as a wrong texture does: truth within three standard deviations."""
    generator = torch.Generator().manual_seed(3)

    def patches(images):
        T, V, H, W, C = images.shape
        coarse = torch.randn(V, H // 8, W // 8, C, generator=generator, dtype=images.dtype)
        visible = (images < 0.99).any(-1, keepdim=True)  # where the body is
        return 0.05 * coarse.repeat_interleave(8, 1).repeat_interleave(8, 2) * visible

    identified = identified_in(law("hencky", E=4e4, nu=0.3), {"hencky": ELASTIC}, noise=patches)
    true = named_combinations({"E": 4e4, "nu": 0.3})
    for name, value, std in identified.best.quantities(identified.settings):
        assert abs(math.log(value / true[name])) < 3 * std, name
        assert std >= identified.settings.model_std


def test_a_family_that_diverges_loses_and_alone_is_an_error(monkeypatch):
    import neuma_lib.fitting.video_residuals as module

    def rollout_batch(model, laws, *args, **options):
        paths = real(model, laws, *args, **options)
        wild = [type(law.elasticity).__name__ == "NeoHookean" for law in laws]
        return [None if diverged else path for diverged, path in zip(wild, paths, strict=True)]

    real = module.rollout_batch
    monkeypatch.setattr(module, "rollout_batch", rollout_batch)
    truth, wild = law("hencky", E=5e4), law("neo_hookean")
    identified = identified_in(truth, {"hencky": ELASTIC, "neo_hookean": wild})
    assert (
        identified.best.family.name == "hencky"
        and identified.as_dict()["families"]["neo_hookean"]["diverged"]
    )
    with pytest.raises(NonFiniteError, match="softer"):
        identified_in(truth, {"neo_hookean": wild})


def fits(**scores: float) -> list[FamilyFit]:
    specs = {
        "hencky": ELASTIC,
        "von_mises": PLASTIC,
        "drucker_prager": law("hencky", "drucker_prager", friction_angle=30),
        "neo_hookean": law("neo_hookean"),
    }
    return [FamilyFit(Family(name, specs[name]), {}, score=score) for name, score in scores.items()]


def test_near_scores_are_ties_unless_one_family_contains_the_chosen_one():
    options = settings({"hencky": ELASTIC}, tie=0.1)
    best, ties = select_family(
        fits(hencky=-8.0, von_mises=-7.95, neo_hookean=-7.95, drucker_prager=-7.8), options
    )
    assert best.family.name == "hencky" and ties == ["neo_hookean"]
    best, ties = select_family(fits(hencky=-7.95, von_mises=-8.0), options)
    assert best.family.name == "von_mises" and ties == ["hencky"]
    with pytest.raises(NonFiniteError, match="every candidate"):
        select_family(fits(hencky=math.inf), options)


def test_nesting_of_families():
    bingham = Family("bingham", law("hencky", "viscous_flow", viscosity=50, yield_stress=1e3))
    elastic, plastic, fluid = (Family("x", spec) for spec in (ELASTIC, PLASTIC, FLUID))
    grains = Family("x", law("hencky", "drucker_prager", friction_angle=30))
    assert bingham.contains(plastic) and bingham.contains(fluid) and bingham.contains(elastic)
    assert plastic.contains(elastic) and not plastic.contains(fluid) and not plastic.contains(plastic)
    assert not grains.contains(elastic), "sand bears no tension, whatever its friction"
    assert not plastic.contains(Family("x", law("neo_hookean")))


def test_stiffness_that_the_time_step_does_not_bear_has_a_difference_too():
    """At the stiffest that dt bears no small step changes the law: the difference is taken over a long one."""
    body, seen = video_of(ELASTIC, V0, FRAMES)
    chosen = settings({"hencky": ELASTIC}, covariance_from="elastic", refined_particles=0)
    video, family = VideoResiduals(MODEL, known(body), body, seen, chosen), Family("hencky", ELASTIC)
    run = FamilyRun(family, [video], [len(FRAMES)], chosen)
    run._origin = family.unbounded({"E": 1e9, "nu": 0.3})
    run._u[0] = math.log(run.values["E"] / 1e9) + 0.5  # beyond the limit by more than a small step
    here = run._residual(run._u)
    by_stiffness, by_nu = run._constant_columns(run._u, here)
    assert by_stiffness[0].abs().max() > 0 and by_nu[0].isfinite().all()


def test_unbounded_constants_return_and_stay_within_bounds_and_the_time_step():
    family = Family("grains", law("hencky", "drucker_prager", E=3e4, nu=0.2, friction_angle=40))
    values = {"E": 3e4, "nu": 0.2, "friction_angle": 40.0}
    assert family.bounded(family.unbounded(values)) == pytest.approx(values, rel=1e-12)
    for far in (-100.0, 100.0):
        values = family.values(np.array([abs(far), far, far]), MODEL, DENSITY)
        assert 0 < values["nu"] < 0.5 and 0 < values["friction_angle"] < 90
        number = MODEL.check_courant(analytic_law(family.law_spec(values)), DENSITY)
        assert number == pytest.approx(MAX_COURANT, rel=1e-3) or values["E"] < 1e-3
        assert MAX_COURANT < 0.9 * COURANT_LIMIT, "a correction may stiffen the law by a fifth"


def test_constants_between_any_bounds_are_unbounded_and_return():
    """Also those whose lower bound is not 0: exponents from 0.2, angles from -180 degrees."""
    flow = {"name": "herschel_bulkley", "consistency": 8.0, "exponent": 2.0, "yield_stress": 30.0}
    fibres = {"name": "fibre_reinforced", "E": 3e4, "nu": 0.2, "fibre_modulus": 1e5, "fibre_exponent": 2.0}
    paste = Family("paste", {"elasticity": {"name": "hencky", "E": 3e4, "nu": 0.2}, "plasticity": flow})
    tendon = Family("tendon", {"elasticity": {**fibres, "azimuth": -120.0, "elevation": 25.0}})
    for family, low, high in (
        (paste, {"exponent": 0.2}, {"exponent": 3.0}),
        (tendon, {"azimuth": -180.0}, {}),
    ):
        u = family.unbounded(family.guess)
        assert family.bounded(u) == pytest.approx(family.guess, rel=1e-12)
        for bounds, far in ((low, -100.0), (high, 100.0)):
            values = family.bounded(np.where([key in bounds for key in family.constants], far, u))
            assert {key: values[key] for key in bounds} == pytest.approx(bounds, rel=1e-4)


def test_less_flow_is_towards_the_elastic_limit_and_within_bounds():
    values = {"E": 3e4, "nu": 0.2}
    family = Family("plastic", law("hencky", "von_mises", yield_stress=4e3))
    result = family.with_other_limits({**values, "yield_stress": 1e3}, (1, 2))
    assert [v["yield_stress"] for v in result] == pytest.approx([4e3, 1.6e4])
    assert all(v["E"] == pytest.approx(3e4) and v["nu"] == pytest.approx(0.2) for v in result)
    grains = Family("grains", law("hencky", "drucker_prager", friction_angle=30))
    angles = [
        v["friction_angle"] for v in grains.with_other_limits({**values, "friction_angle": 30.0}, (1, 2))
    ]
    assert 30 < angles[0] < angles[1] < 90
    assert Family("elastic", ELASTIC).with_other_limits(values, (1, 2)) == []


def test_a_plastic_family_starts_from_weak_flow_and_from_fits_of_others(monkeypatch):
    """From its guesses and weaker limits of the last one, and from an elastic fit, then nearer to its elastic limit."""
    starts = []

    class Run(SimpleNamespace):
        alive = True

        def resembles(self, other):
            return False

        def begin(self, given, below):
            starts.append([(values["E"], values["yield_stress"]) for values in given])

    fit = SimpleNamespace(cost=1.0)
    monkeypatch.setattr(
        identification, "FamilyRun", lambda family, *given: Run(family=family, fit=fit, loss=1.0, rollouts=1)
    )
    elastic = Run(family=Family("elastic", ELASTIC), fit=fit, values={"E": 5e4, "nu": 0.2})
    family = Family("plastic", law("hencky", "von_mises", E=3e4, nu=0.3, yield_stress=4e3))
    published = {"E": 6e4, "nu": 0.3, "yield_stress": 8e3}
    best = _first_fit(family, [], [elastic], published, settings({"elastic": ELASTIC}))
    (first, second), guess = starts, (3e4, 4e3)
    assert first == [pytest.approx(each) for each in (guess, (6e4, 8e3), (6e4, 2e3), (6e4, 500.0))]
    limit = second[0][1]  # the elastic fit is the best one, and that of a family that this one contains
    assert second == [pytest.approx((5e4, factor * limit)) for factor in (1, 1, 4, 16)]
    assert best.rollouts == 2


def test_a_published_law_gives_what_the_family_has():
    family = Family("plastic", PLASTIC)
    known = {"E": 1e5, "nu": -0.2, "friction_angle": 25.0}
    assert family.with_guesses(known) == {"E": 1e5, "nu": 0.3, "yield_stress": 4e3}
    bounds = {"E": 0.0, "nu": 0.0, "yield_stress": 0.0}  # have no logarithm or logit
    assert family.with_guesses(bounds) == family.with_guesses({})


def test_combinations_are_those_of_the_covariance():
    """Of a body whose E is open and nu sure, the ratio of both moduli is determined and their product is not."""
    family = Family("hencky", ELASTIC)
    fit = FamilyFit(family, {"E": 6e4, "nu": 0.3}, covariance=np.diag([0.25, 1e-12]))
    options = settings({"hencky": ELASTIC}, model_std=0.02)
    first, second = fit.combinations(options)
    assert first["determined"] and not second["determined"]
    assert second["powers"]["G"] == pytest.approx(second["powers"]["K"], abs=1e-4)  # log E moves both alike
    assert second["log_std"] == pytest.approx(math.sqrt(2) * 0.5, rel=1e-2)
    (_, E, std), *_ = fit.quantities(options)
    assert E == 6e4 and std == pytest.approx(0.5, rel=1e-2)


def test_errors_that_all_images_share_are_part_of_every_uncertainty():
    """Images without any error leave `model_std`."""
    family, start = Family("hencky", ELASTIC), known(ball())
    fit = FamilyFit(family, {"E": 6e4, "nu": 0.3}, 1.0, covariance=np.zeros((2, 2)), motions=(start,))
    options = settings({"hencky": ELASTIC}, model_std=0.07)
    assert [std for *_, std in fit.quantities(options)] == pytest.approx(
        [0.07] * len(fit.quantities(options))
    )
    assert [each["log_std"] for each in fit.combinations(options)] == pytest.approx([0.07, 0.07])
    stds = [each["log_std"] for each in fit.as_dict(options)["quantities"].values()]
    assert stds == pytest.approx([0.07] * len(stds))


def test_the_laplace_approximation_is_the_covariance_for_independent_noise():
    """Of a linear problem with the prior, against the normal equations written out, and against many noisy problems."""
    generator, sigma, spreads = np.random.default_rng(0), 0.3, np.array([2.0, 0.5, 1.0])
    J = generator.standard_normal((400, 3))
    truth = spreads * generator.standard_normal((500, 3))
    residuals = truth @ J.T + sigma * generator.standard_normal((500, 400))
    precision = J.T @ J / sigma**2 + np.diag(spreads**-2.0)
    fit = Linearisation((J.T @ J)[None], np.zeros((1, 3)), 400 * sigma**2, sigma)
    covariance = laplace(fit, spreads)
    np.testing.assert_allclose(covariance, np.linalg.inv(precision), rtol=1e-10)
    errors = residuals @ J @ covariance / sigma**2 - truth
    np.testing.assert_allclose(errors.std(axis=0), np.sqrt(np.diag(covariance)), rtol=5 * 500**-0.5)


def test_an_identification_records_the_laplace_approximation_and_comparable_scores():
    """With residuals of one pixel noise it is smaller than the jackknife, which includes more."""
    families = {"hencky": ELASTIC, "neo_hookean": law("neo_hookean")}
    content = identified_in(law("hencky", E=1.5e4, nu=0.35), families, pyramid=(8, 32)).as_dict()
    assert set(content["compared"]) == {n for n, fit in content["families"].items() if "score" in fit}
    assert content["family"] in content["compared"]
    own = content["best"]
    whole, plain = (np.array(own["unbounded"][key]) for key in ("covariance", "laplace"))
    assert plain.shape == whole.shape and (np.diag(plain) > 0).all()
    assert 0 < own["quantities"]["E"]["laplace_log_std"] < own["quantities"]["E"]["log_std"]
    assert own["quantities"]["E"]["laplace_log_std"] == pytest.approx(plain[0, 0] ** 0.5, rel=1e-3)


def test_a_summary_lists_what_is_determined_and_what_is_not():
    family = Family("plastic", PLASTIC)
    values = {"E": 6e4, "nu": 0.3, "yield_stress": 4e3}
    fit = FamilyFit(family, values, 1.0, covariance=np.diag([0.25, 1e-8, 1e-8]))
    options = settings({"hencky": ELASTIC})
    text = Identified(fit, ["other"], {}, [], [], 0, 24, options).summary()
    assert text.startswith("plastic (tie with other): E = 6e+04, nu = 0.3, yield_stress = 4000; determined: ")
    determined, rest = text.partition("; determined: ")[2].split("; not determined: ")
    assert "yield_stress" in determined.split(", ") and "E" in rest.split(", ")
    sure = replace(fit, covariance=1e-8 * np.eye(3))
    assert "not determined" not in Identified(sure, [], {}, [], [], 0, 24, options).summary()


def test_images_are_averaged_over_squares():
    images = torch.arange(2 * 3 * 5 * 5 * 3, dtype=torch.float64).reshape(2, 3, 5, 5, 3)
    blurred = averaged(images, 2)
    assert blurred.shape == (2, 3, 3, 3, 3)
    torch.testing.assert_close(blurred[1, 2, 0, 1], images[1, 2, :2, 2:4].mean((0, 1)))
    torch.testing.assert_close(blurred[1, 2, 2, 2], images[1, 2, 4, 4])  # the corner that is there
    assert averaged(images, 1) is images


def test_few_frames_and_unknown_constants_are_named():
    body = ball()
    with refused("frames"):
        identify(MODEL, known(body), body, observe(body, V0, (0, 4, 8)), settings({"hencky": ELASTIC}))
    with refused("Hencky"):
        Family("x", {"elasticity": {"name": "hencky", "E": 1e4, "nu": 0.3, "stiffness": 2}})
    both = {"name": "von_mises", "yield_stress": 1e3, "nu": 0.2}
    with refused("identify.families.x.plasticity"):
        Family("x", ELASTIC | {"plasticity": both})


@pytest.mark.parametrize("v0", [V0, (0.0, 1.0, 0.0)])
def test_a_video_without_contact_is_refused_before_anything_is_fitted(v0, monkeypatch):
    """The expected time is that at which the surface of the lowest particle falls on the floor, to two digits."""
    monkeypatch.setattr("neuma_lib.fitting.identify.VideoResiduals", None)
    body, frames = ball(), (0, 8, 16, 24)
    gap, fall = float((body.x0[:, 1] - contact_radius(body.vol0)).min()), -MODEL.gravity[1] * MODEL.dt
    b = v0[1] / fall - 0.5  # gap + n dt v - g dt^2 n (n + 1) / 2 = 0
    n = math.ceil(b + math.sqrt(b * b + 2 * gap / (fall * MODEL.dt)))
    expected = f"first contact, expected at about {n * MODEL.dt:.2g} s"
    with refused("frames", problem=expected, remedy="longer video"):
        identify(MODEL, known(body, v0=v0), body, observe(body, v0, frames), settings({"hencky": ELASTIC}))


@pytest.mark.parametrize("fit", [Training, lambda *values: SpringGaus().fit(values[0], {}, *values[3:])])
def test_methods_that_train_refuse_it_too(fit, monkeypatch):
    body = ball(dtype=torch.float32)
    seen = observe(body, V0, (0, 8, 16, 24))
    for module in ("methods.training", "io.particles"):
        monkeypatch.setattr(f"neuma_lib.{module}.load_reconstruction", lambda *files, **options: body)
        monkeypatch.setattr(f"neuma_lib.{module}.with_motion", lambda body, file: body.state(V0))
    for module in ("methods.training", "io.images"):
        monkeypatch.setattr(f"neuma_lib.{module}.load_videos", lambda *files, **exposure: [seen])
    inputs = dict.fromkeys(("particles", "binding", "gaussians", "velocity", "transforms"), "none")
    problem = Problem({"dt": MODEL.dt, "grid": MODEL.grid}, [1000.0], {})
    with refused("frames", problem="first contact"):
        fit(inputs, {}, TrainingConfig(), problem, SimpleNamespace(device=torch.device("cpu")))


def test_a_turning_body_touches_the_floor_where_one_without_spin_does_not():
    """A bar of 0.8 m, 0.3 m above the floor, without gravity. After 100 steps the spin has turned it by 90 degrees."""
    bar = torch.tensor([[x, 0.3, 0.5] for x in (0.1, 0.5, 0.9)], dtype=torch.float64)
    ones, model = torch.full((3,), 1e-6, dtype=torch.float64), replace(MODEL, gravity=(0.0, 0.0, 0.0))
    still, turning = (
        State.rigid(bar, ones, ones, (0.0, 0.0, 0.0), (0.0, 0.0, spin))
        for spin in (0.0, math.pi / 2 / (100 * model.dt))
    )
    check_contact(model, [(turning, (0, 100))])
    check_contact(model, [(still, (0, 100)), (turning, (0, 100))])  # the other video shows the material
    with refused("frames", problem="first contact is missing"):
        check_contact(model, [(still, (0, 100))])


class Line:
    """Residuals a u - b of one frame, with sign changes of u beyond a wall."""

    def __init__(self, a: np.ndarray, b: np.ndarray, wall: float = math.inf):
        self.a, self.b, self.wall = a, b, wall

    def cost(self, u):
        return math.inf if u[0] > self.wall else float(((self.a @ u - self.b) ** 2).sum())

    def linearise(self, u, free, exact=True):
        r = self.a @ u - self.b
        columns = self.a.reshape(16, -1, self.a.shape[1])
        scores = (columns.transpose(0, 2, 1) @ r.reshape(16, -1, 1))[..., 0]
        return Linearisation(
            columns.transpose(0, 2, 1) @ columns, scores, float(r @ r), float(np.sqrt(r @ r))
        )


class Bend:
    """Residuals of exp(u_0), u_0 + u_1 and 0.1 u_1 to targets, with updated derivatives unless they must be exact."""

    def __init__(self, targets: np.ndarray):
        self.targets, self.differentiated, self.at, self.J = targets, 0, None, None

    def residual(self, u):
        return np.array([np.exp(u[0]), u[0] + u[1], 0.1 * u[1]]) - self.targets

    def cost(self, u):
        return float((self.residual(u) ** 2).sum())

    def linearise(self, u, free, exact=True):
        r, known = self.residual(u), self.at is not None
        if exact or not known:
            self.J = np.array([[np.exp(u[0]), 0.0], [1.0, 1.0], [0.0, 0.1]])
            self.differentiated += 1
        elif (step := u - self.at).any():
            change = torch.from_numpy(r - self.residual(self.at) - self.J @ step)
            columns = secant_update(list(torch.from_numpy(self.J.T.copy())), step.tolist(), change)
            self.J = torch.stack(columns, dim=1).numpy()
            np.testing.assert_allclose(self.J @ step, r - self.residual(self.at), atol=1e-12)
        self.at = u.copy()
        exact = exact or not known
        return Linearisation((self.J.T @ self.J)[None], (self.J.T @ r)[None], self.cost(u), 1.0, exact)


def test_updated_derivatives_reach_the_same_minimum_with_fewer_differentiations():
    none = lambda fit: np.zeros((2, 2))  # noqa: E731
    targets, results, counts = np.array([3.0, 0.5, 0.2]), [], []
    for secant in (False, True):
        problem = Bend(targets)
        u, fit, _ = levenberg_marquardt(problem, np.zeros(2), [0, 1], none, 1e-14, 40, secant=secant)
        assert fit.exact and np.abs(fit.slope).max() < 1e-5
        results.append(u)
        counts.append(problem.differentiated)
    np.testing.assert_allclose(*results, atol=1e-5)
    assert counts[1] < counts[0]


def test_a_rough_fit_and_a_hopeless_one_differentiate_less():
    """A rough fit ends with updated derivatives near the minimum, one beyond the limit of the cost at once."""
    none = lambda fit: np.zeros((2, 2))  # noqa: E731
    targets = np.array([3.0, 0.5, 0.2])
    problem = Bend(np.array([3.0, 0.5, 0.2]))
    hopeless = Bend(np.array([3.0, 0.5, 9.0]))
    exact, _, _ = levenberg_marquardt(Bend(targets), np.zeros(2), [0, 1], none, 1e-14, 40)
    u, fit, _ = levenberg_marquardt(problem, np.zeros(2), [0, 1], none, 1e-6, 40, secant=True, rough=True)
    assert not fit.exact and problem.differentiated == 1
    np.testing.assert_allclose(u, exact, atol=0.02)
    u, fit, accepted = levenberg_marquardt(
        hopeless, np.zeros(2), [0, 1], none, 1e-6, 40, secant=True, limit=1.0
    )
    assert accepted == 0 and hopeless.differentiated == 1 and not u.any()


def test_sums_of_blocks_are_those_of_all_pixels():
    """Of images that the number of blocks does not divide, with background that depends on nothing."""
    generator = torch.Generator().manual_seed(3)
    shape, k = (2, 3, 10, 13, 3), 4
    *columns, r = (torch.randn(shape, generator=generator) for _ in range(k + 1))
    for column in columns:
        column[:, :, :4] = 0.0
    curvatures, scores = block_sums(columns, r)
    assert curvatures.shape == (3 * BLOCKS**2, k, k) and scores.shape == (3 * BLOCKS**2, k)
    J = torch.stack([in_blocks(column) for column in columns], dim=-1).double()
    np.testing.assert_allclose(curvatures, J.mT @ J, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(
        scores, (J.mT @ in_blocks(r).double()[..., None])[..., 0], rtol=1e-10, atol=1e-12
    )


def test_least_squares_of_a_line_and_its_jackknife():
    """Independent noise: the jackknife's variance is that of linear regression, sigma^2 (A^T A)^-1, and infinite cost
    is a wall that is not passed."""
    generator = np.random.default_rng(0)
    a, errors, stds = generator.standard_normal((1600, 2)), [], []
    none = lambda fit: np.zeros((2, 2))  # noqa: E731
    for _ in range(20):
        b = a @ [2.0, -1.0] + 0.3 * generator.standard_normal(1600)
        u, fit, _ = levenberg_marquardt(Line(a, b), np.zeros(2), [0, 1], none, 1e-12, 20)
        errors.append(u - [2.0, -1.0])
        stds.append(np.sqrt(np.diag(jackknife(fit, none(fit)))))
    expected = 0.3 * np.sqrt(np.diag(np.linalg.inv(a.T @ a)))
    np.testing.assert_allclose(np.mean(stds, axis=0), expected, rtol=0.25)
    assert np.abs(errors).max() < 4 * expected.max()
    u, *_ = levenberg_marquardt(Line(a, b, wall=1.5), np.zeros(2), [0, 1], none, 1e-12, 40)
    assert 1.0 < u[0] <= 1.5
