"""Identification of family and constants in videos with a known truth, and its uncertainty."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from neuma_lib.config.training import TrainingConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.errors import NonFiniteError
from neuma_lib.fitting.families import Family
from neuma_lib.fitting.family_run import FamilyRun
from neuma_lib.fitting.frame_batches import check_contact, first_contact
from neuma_lib.fitting.identify import identify
from neuma_lib.fitting.video_residuals import Candidate, VideoResiduals, averaged, finer
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.files import write_json
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.combinations import named_combinations
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
from tests.support.errors import refused
from tests.support.grounding_scene import MODEL, RADIUS, camera, observe
from tests.support.identification import (
    ELASTIC,
    FLUID,
    FRAMES,
    HEIGHT,
    PLASTIC,
    SQUARES,
    V0,
    ball,
    identified_in,
    known,
    pixel_noise,
    settings,
    video_of,
)
from tests.support.sim_scenes import law_spec as law

pytestmark = pytest.mark.core


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
    identified_in(ELASTIC, {"hencky": ELASTIC}, other_videos=others, pyramid=(8, 32))
    (alone, _), (both, starts), *_ = begun
    assert (len(alone.videos), len(both.videos)) == (1, 2) and alone.refined and alone.values in starts


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
