"""Expected results of experiments, against what fits of it report; limits of the lab; refusals."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.laws import LawConfig
from neuma_lib.config.next import NextConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.fitting.candidate_experiments import STARTS, draw_starts, flight, placed, second_cameras
from neuma_lib.fitting.choose_next import choose_next, read_fit, read_rivals
from neuma_lib.fitting.families import Family
from neuma_lib.fitting.family_run import FamilyRun
from neuma_lib.fitting.identified import FamilyFit
from neuma_lib.fitting.identify import identify
from neuma_lib.fitting.next_experiment import (
    Experiment,
    Knowledge,
    added,
    information,
    matched_noise,
    motion_derivatives,
    motion_std,
    newly_determined,
    spread,
    stds,
    undetermined,
    unfilmed,
)
from neuma_lib.fitting.video_residuals import NUISANCES, Candidate, noise_ratio, weigh
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.clamps import clamped_particles
from neuma_lib.sim.rollout import rollout
from neuma_lib.splatting.observation import Observation
from tests.support.errors import refused
from tests.support.grounding_scene import MODEL, ball, camera, observe
from tests.support.sim_scenes import law_spec as law

pytestmark = pytest.mark.core

V0, STD = (0.5, -1.5, 0.0), (0.03, 0.03, 0.05, 0.1, 0.1, 0.1)
FRAMES = tuple(range(0, 121, 8))
HENCKY = law("hencky")
TRUTH = law("hencky", E=3e4, nu=0.4)


def settings(**families) -> IdentifyConfig:
    named = {name: LawConfig(**spec) for name, spec in (families or {"hencky": HENCKY}).items()}
    return IdentifyConfig(families=named, pyramid=(8, 32), pose_tolerance=0.0, covariance_from="elastic")


def motion(v0=V0, std=STD, body=None) -> InitialMotion:
    body = body or ball(0.27)
    centre = (body.mass @ body.x0 / body.mass.sum()).numpy()
    return InitialMotion(np.array(v0), np.zeros(3), centre, np.eye(3), np.array(std))


def experiment(v0=V0, std=STD, frames=FRAMES) -> Experiment:
    return Experiment(MODEL, motion(v0, std), ball(0.27), [unfilmed(frames, camera())])


def fitted(covariance, E=3e4, nu=0.4, spec=HENCKY) -> FamilyFit:
    family = Family("hencky", spec)
    values = family.with_guesses({"E": E, "nu": nu})
    return FamilyFit(family, values, covariance=np.array(covariance, float))


def video(v0, seed):
    """A noisy video of a launch, with the initial motion and the body."""
    body = ball(0.27)
    seen = observe(body, v0, FRAMES, TRUTH)
    noise = 0.01 * torch.randn(
        seen.images.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )
    return motion(v0), body, Observation(seen.frames, seen.images + noise, seen.cameras)


@pytest.fixture(scope="module")
def alone():
    """The identification in a video of one launch."""
    return identify(MODEL, *video(V0, 5), settings())


@pytest.fixture(scope="module")
def known(alone):
    return Knowledge.of_videos(alone.best, [experiment()], settings())


def log_stds(fit: FamilyFit) -> np.ndarray:
    return np.sqrt(np.diag(fit.log_covariance(lambda values: values)[1]))


def at(fit: FamilyFit) -> Candidate:
    return Candidate(fit.family.law_spec(fit.values), np.zeros(NUISANCES))


def test_a_coarser_grid_changes_the_images_of_an_experiment(known):
    """Slow twin: images of two simulators. The observed images have no influence."""
    own, one = experiment(), at(known.fit)
    coarse = replace(own, model=replace(MODEL, grid=round(MODEL.grid / 1.5)))
    # The same black video is subtracted from both.
    ((fine,),), ((other,),) = (
        each.residuals(settings()).residuals([one], len(FRAMES)) for each in (own, coarse)
    )
    expected = float((fine - other).double().square().mean())
    video = own.residuals(settings())
    for weight in (1.0, 0.5):
        video.weight = weight
        assert video.coarser_difference(one, 1.5) == pytest.approx(expected, rel=1e-4) and expected > 0
        assert video.coarser_difference(one, 1.0) == pytest.approx(0, abs=1e-4 * expected)
        assert video.observe(one)


def test_noise_is_the_residual_with_what_a_coarser_grid_changes_more():
    """1 + (d' - d) / max(r, d), at least 1, and finite for a video whose simulation on a coarser grid diverges."""
    assert noise_ratio(0.4, of_first=0.1, loss=0.01) == pytest.approx(4)
    assert noise_ratio(0.4, of_first=0.1, loss=0.2) == pytest.approx(2.5)
    assert noise_ratio(0.05, of_first=0.1, loss=0.2) == noise_ratio(0.1, of_first=0.1, loss=0.2) == 1
    assert noise_ratio(math.inf, of_first=math.inf, loss=0.2) == 1
    assert 1 < noise_ratio(math.inf, of_first=0.1, loss=0.2) < math.inf
    assert math.isfinite(noise_ratio(0.1, of_first=0.0, loss=0.0))


def test_forecasts_and_joint_fits_have_the_same_noise(known):
    """A fast launch, whose images change more on a coarser grid, has a lower weight than the first video, also with
    fewer frames, by the ratio of the noise that its forecast has."""
    same, fast = experiment(), experiment((0.2, -2.5, 0.3), frames=FRAMES[::2])
    videos = [each.residuals(settings()) for each in (same, fast)]
    first = weigh(videos, at(known.fit), known.fit.loss)
    assert known.difference == pytest.approx(first)
    assert videos[0].coarser_difference(at(known.fit), 1.5) == pytest.approx(first)
    ratio = known.noise_in(fast.residuals(settings())) / known.noise
    assert ratio > 1.2 and known.noise_in(same.residuals(settings())) == pytest.approx(known.noise)
    assert videos[0].weight == videos[0].noise == 1 and videos[1].noise == pytest.approx(ratio)
    pixels = videos[1].fitted_pixels / videos[0].fitted_pixels
    assert pixels < 0.6 and videos[1].weight == pytest.approx((pixels * ratio) ** -0.5)
    both = Knowledge.of_videos(known.fit, [same, fast], settings())
    assert both.difference == pytest.approx(first)
    rough = replace(
        known, fit=replace(known.fit, loss=10 * first)
    )  # the residual is larger than the difference
    after = first * ratio
    assert rough.noise_in(fast.residuals(settings())) == pytest.approx(
        known.noise * noise_ratio(after, first, 10 * first)
    )


def test_a_joint_fit_weighs_its_videos(monkeypatch):
    """By the law that fits the first one best. Losses are relative to the noise."""
    weighed = []

    def recorded(videos, one, loss):
        weighed.append((videos, one, loss))
        return weigh(videos, one, loss)

    monkeypatch.setattr("neuma_lib.fitting.identify.weigh", recorded)
    both = identify(MODEL, *video(V0, 5), settings(), other_videos=[video((0.2, -2.5, 0.3), 6)])
    ((videos, one, loss),) = weighed
    assert videos[0].noise == 1 and videos[1].noise > 1.2
    assert one.law["elasticity"]["E"] == pytest.approx(3e4, rel=0.1) and loss < 1e-3
    fit, held_out = both.fits["hencky"], []
    for each in videos:
        (own,) = each.residuals([at(fit)], len(each.frames))
        squares = torch.cat([r[each.fitted :] for r in own]).double().square()
        held_out.append(float(squares.mean()) / (each.weight**2 * each.noise))
    assert fit.held_out == pytest.approx(sum(held_out) / 2, rel=0.2)


@pytest.mark.parametrize("v0", [(0.2, -2.5, 0.3), (0.0, -0.5, 0.0)])
def test_predicted_deviations_are_those_that_a_joint_fit_reports(alone, known, v0):
    """A fast launch and a slow one with little information. The jackknife over the few blocks that show the ball has a
    relative error of about 1 / sqrt(2 * 8) for a deviation; twice the ratio of two of them is a factor of 2."""
    forecast = known.forecast(experiment(v0))
    both = identify(MODEL, *video(V0, 5), settings(), other_videos=[video(v0, 6)])
    ratio = log_stds(forecast.fit) / log_stds(both.best)
    assert (0.5 < ratio).all() and (ratio < 2).all()
    # The same launches in the same order.
    assert (log_stds(forecast.fit) <= log_stds(alone.best)).all()


def test_a_faster_launch_has_more_information_and_a_flight_none(known):
    slow, fast = (known.forecast(experiment(v0)) for v0 in ((0.0, -0.5, 0.0), (0.2, -2.5, 0.3)))
    assert spread(fast.fit, settings()) < spread(slow.fit, settings())
    flying = known.forecast(experiment((0.0, 1.0, 0.0), frames=(0, 8, 16, 24)))
    assert np.abs(flying.information).max() < 1e-6 * np.abs(fast.information).max()
    assert flying.fit.covariance == pytest.approx(known.fit.covariance, rel=1e-6)


def test_a_certain_motion_has_more_information(known):
    """The information with an exact initial motion exceeds that with an uncertain one in every direction."""
    unsure, sure = (
        known.forecast(experiment((0.2, -2.5, 0.3), std)).information for std in (STD, (0.0,) * 6)
    )
    assert np.linalg.eigvalsh(sure - unsure).min() > 0


def test_information_is_that_of_the_inverse_and_adds():
    """Slow twins: the block of the inverse of all unknowns with their prior, and sums of inverses."""
    g = np.random.default_rng(3)
    J = g.normal(size=(40, 6))
    H, noise, k = J.T @ J, 0.7, 2
    prior = np.diag([0.0, 0.0, 1.0, 1.0, 1.0, 1.0])
    block = np.linalg.inv(H / noise + prior)[:k, :k]
    gained = information(H, noise, k)
    assert gained == pytest.approx(np.linalg.inv(block))
    before = np.diag([0.5, 9.0])
    expected = np.linalg.inv(np.linalg.inv(before) + 3 * gained)
    assert added(before, gained, 2 * gained) == pytest.approx(expected)
    assert added(added(before, 2 * gained), gained) == pytest.approx(expected)


def test_noise_is_that_of_the_reported_covariance():
    g = np.random.default_rng(4)
    J = g.normal(size=(40, 5))
    reported = np.linalg.inv(information(J.T @ J, 0.3, 2) + np.eye(2) / 9)
    assert matched_noise(J.T @ J, reported, 3.0) == pytest.approx(0.3, rel=1e-6)


def test_the_noise_of_a_fit_reproduces_its_determinant(alone, known):
    """The existing video again, from no knowledge: its information has the determinant of the reported covariance."""
    gained = known.forecast(experiment()).information
    prior = np.eye(2) / settings().spread ** 2
    reported = -np.linalg.slogdet(alone.best.covariance)[1]
    assert np.linalg.slogdet(gained + prior)[1] == pytest.approx(reported, abs=1e-6)


def test_evidence_is_that_of_a_fit_of_the_rival(known):
    """Slow twin: the rival is fitted to the images of the identified family in both videos. The expected evidence of
    the second one is within a third of half the squared residuals over the noise that remain."""
    chosen, rival = settings(), Family("neo_hookean", law("neo_hookean"))
    second = experiment((0.1, -1.8, 0.1))
    knowing = Knowledge.of_videos(known.fit, [experiment()], chosen, [(rival, known.fit.values)])
    expected = knowing.forecast(second).evidence["neo_hookean"]
    costs = []
    for experiments in ([experiment()], [experiment(), second]):
        videos = [each.residuals(chosen) for each in experiments]
        for each in videos:
            assert each.observe(at(known.fit))
            each.weight = math.sqrt(known.noise / knowing.noise_in(each))
        run = FamilyRun(rival, videos, [len(FRAMES)] * len(videos), chosen)
        run.imitate(known.fit.values, known.noise)
        costs.append(0.5 * (run.fit.cost / known.noise + float(run.deviations @ run.deviations)))
    assert expected == pytest.approx(costs[1] - costs[0], rel=1 / 3)
    assert expected > 3


def test_the_combination_that_becomes_determined_is_named():
    chosen = settings()
    # G and K as unknowns: only K becomes determined, from a factor of 2 to 3 %.
    fit = fitted(np.eye(2))
    _, slope = fit.log_covariance(lambda values: {"E": values["E"], "nu": values["nu"]})
    unsure, sure = fitted(1e-4 * np.eye(2)), fitted(1e-6 * np.eye(2))
    assert newly_determined(unsure, sure, chosen) == {}
    vague = fitted([[0.04, 0.0], [0.0, 0.04]])
    gained = newly_determined(vague, sure, chosen)
    assert {"E", "G", "K"} == set(gained) and all(after < 0.1 <= before for before, after in gained.values())
    # A mixture alone: along one axis of the unbounded constants everything is known, along the other nothing.
    axis = np.array([0.6, 0.8])
    mixed = fitted(np.outer(axis, axis) * 1e-6 + np.outer([-0.8, 0.6], [-0.8, 0.6]) * 0.5)
    (name, (before, after)), *others = newly_determined(fitted(0.5 * np.eye(2)), mixed, chosen).items()
    assert not others and "^" in name and after < 0.1 <= before
    assert slope.shape == (2, 2)
    # The error that all images share remains, and can be too large.
    pairs = [
        newly_determined(fitted(0.5 * np.eye(2)), mixed, chosen.model_copy(update={"model_std": std}))
        for std in (0.0, 0.06, 0.1)
    ]
    (exact,), (wider,) = (pair.values() for pair in pairs[:2])
    assert wider == pytest.approx([math.hypot(std, 0.06) for std in exact]) and pairs[2] == {}


def test_predicted_motion_is_as_uncertain_as_that_of_drawn_constants(known):
    """Slow twin: the motion of another launch for 60 drawn constants. Their deviation has a relative error of
    1 / sqrt(2 * 60) = 9 %, three of them are 27 %."""
    covariance = np.array([[4e-4, 1e-4], [1e-4, 9e-4]])
    body, frames = ball(0.27), FRAMES
    start = motion((0.0, -2.0, 0.0)).of_body(body)
    derivatives = motion_derivatives(known.fit, MODEL, start, frames, settings())
    std = motion_std(derivatives, covariance)
    family, u = known.fit.family, known.fit.family.unbounded(known.fit.values)
    drawn = u + np.random.default_rng(0).multivariate_normal(np.zeros(2), covariance, 60)

    def moved(point):
        spec = family.law_spec(family.bounded(point))
        return rollout(MODEL, analytic_law(spec, MODEL.dt), start, steps=frames[-1], frames=frames).x

    with torch.no_grad():
        away = torch.stack([moved(point) - moved(u) for point in drawn])
    assert std == pytest.approx(math.sqrt(float(away.square().sum(-1).mean())), rel=0.27)
    assert 1e-4 < std < 0.1


def starts(lab: NextConfig, count=12, kind="launch"):
    body = ball(0.27)
    return draw_starts(MODEL, body, motion(body=body), FRAMES[-1], lab, count, 1, kind)


def test_launches_keep_the_limits_of_the_lab_and_reach_the_floor_first():
    lab = NextConfig(max_height=0.6, max_speed=2.0, max_spin=0.0)
    drawn = starts(lab)
    assert len(drawn) == 12 and len({launch.settings["height"] for launch in drawn}) > 6
    for launch in drawn:
        own = launch.settings
        assert (
            own["height"] <= 0.6
            and math.dist(own["velocity"], (0, 0, 0)) <= 2.01
            and own["spin"] == [0, 0, 0]
        )
        x = launch.body.x0
        box = ((x.amin(0) + x.amax(0)) / 2).tolist()
        assert box == pytest.approx([own["center"][0], own["height"], own["center"][1]])
        contact, reason = flight(MODEL, launch.body, launch.motion, launch.steps * MODEL.dt)
        assert reason is None and 0.15 * launch.steps * MODEL.dt < contact < 0.65 * launch.steps * MODEL.dt
    assert max(math.dist(t.settings["spin"], (0, 0, 0)) for t in starts(NextConfig(max_spin=5.0))) > 2


def test_the_flight_is_that_of_the_simulation():
    """The first contact of the closed form, against that of simulated steps of a spinning body."""
    body = ball(0.4)
    start = replace(motion((0.3, -1.0, 0.0), body=body), spin=np.array([2.0, -1.0, 3.0]))
    contact, _ = flight(MODEL, body, start, 0.3)
    steps = [int(contact / MODEL.dt) - 3, int(contact / MODEL.dt) + 3]
    path = rollout(
        MODEL,
        analytic_law(TRUTH, MODEL.dt),
        start.of_body(body),
        steps=steps[-1],
        frames=range(steps[-1] + 1),
    )
    speeds = path.v.mean(1)[:, 1].diff() / MODEL.dt
    assert speeds[steps[0] - 1] == pytest.approx(-9.8, rel=1e-3)
    assert speeds[-1] > -9.8 * 0.999


def test_a_turned_body_is_the_same_body():
    """Distances of particles and Gaussians are kept, also between them."""
    body, R = ball(0.3), Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    own = placed(body, R, (0.4, 0.5, 0.6))

    def distances(each):
        return torch.cdist(each.gaussians.means, each.x0)

    assert torch.allclose(distances(own), distances(body), atol=1e-9)
    box = (own.x0.amin(0) + own.x0.amax(0)) / 2
    assert box.tolist() == pytest.approx([0.4, 0.5, 0.6])
    turned = starts(NextConfig(), 4, "turned")
    assert all(math.dist(launch.settings["rotation"], (0, 0, 0)) > 0.1 for launch in turned)


def test_second_cameras_see_the_motion_from_elsewhere():
    points = ball(0.3).x0.numpy()
    first = camera()
    fixed, rendered = (second_cameras(first, points, kind) for kind in (False, True))
    assert len(fixed) == 8 and [place["view"] for place, _ in rendered] == [1, 2, 3, 4, 5]
    for _, own in [*fixed, *rendered]:
        pixels, depth = own.project(torch.from_numpy(points))
        assert (pixels > 0).all() and (pixels < own.width).all() and (depth > 0).all()
        assert float(own.viewmats[0, 2, :3] @ first.viewmats[0, 2, :3]) < 0.99


@pytest.mark.parametrize("kind", STARTS)
def test_no_start_inside_the_box_is_refused(kind):
    with refused("next", problem=f"{kind} is possible"):
        starts(NextConfig(max_height=0.1), kind=kind)


def test_kinds_that_are_not_possible_are_left_out_unless_there_is_no_other(alone):
    """A lab in which nothing moves can film the body from elsewhere, but not press it."""
    lab, lines = NextConfig(candidates=7, max_speed=0, kinds=("press", "camera")), []
    fit = replace(alone.best, covariance=400 * alone.best.covariance)
    choice = choose_next(fit, [experiment()], settings(), lab, log=lines.append)
    assert {option.kind for option in choice.options} == {"camera"} and "press" in "".join(lines)
    with refused("next", problem="press"):
        lab = lab.model_copy(update={"kinds": ("press",)})
        choose_next(fit, [experiment()], settings(), lab)


def test_a_platen_presses_the_body_on_the_floor_and_lets_go():
    """The body lands before the platen touches it, is compressed to where the platen stops, and is free at the end."""
    for start in starts(NextConfig(max_speed=1.5), 4, "press"):
        (platen,) = start.model.colliders
        (_, high, _), (moment, low, _), (end, last, _) = platen.keyframes
        assert last == high and (high[1] - low[1]) / (moment - platen.keyframes[0][0]) <= 1.51
        frames = (0, round(moment / MODEL.dt), start.steps)
        law = analytic_law(TRUTH, MODEL.dt)
        with torch.no_grad():
            path = rollout(
                start.model, law, start.motion.of_body(start.body), steps=start.steps, frames=frames
            )
        top = path.x[..., 1].amax(1)
        bottom = low[1] - platen.size[1]
        assert start.steps * MODEL.dt >= end - 0.03 and top[0] < high[1] - platen.size[1]
        # Surfaces are resolved to half a cell.
        assert abs(top[1] - bottom) < MODEL.dx / 2 and top[1] < top[0] - 0.1 * 2 * 0.13
        assert platen.surface(path.x[-1], start.steps * MODEL.dt)[0].min() > 0


def test_a_clamp_holds_the_body_until_it_lets_go():
    """The clamped particles follow the clamp, and those that are let go fall with g."""
    drawn = starts(NextConfig(max_speed=1.5), 8, "hang")
    assert 0 < sum("release" in s.settings["clamps"][0] for s in drawn) < 8
    for start in drawn:
        (clamp,) = start.model.clamps
        held = clamped_particles([clamp], start.body.x0) == 0
        assert 0.01 < held.double().mean() < 0.5 and not start.motion.std.any()
        turn = round(clamp.keyframes[1][0] / MODEL.dt)
        last = start.steps if math.isinf(clamp.release) else min(start.steps, round(clamp.release / MODEL.dt))
        law = analytic_law(TRUTH, MODEL.dt)
        frames = (0, turn, last, start.steps) if last < start.steps else (0, turn, last)
        with torch.no_grad():
            path = rollout(
                start.model, law, start.motion.of_body(start.body), steps=start.steps, frames=frames
            )
        _, away = clamp.pose(turn * MODEL.dt)
        assert path.x[1, held] == pytest.approx(path.x[0, held] + away, abs=1e-9)
        if last == start.steps:
            assert path.x[-1, held] == pytest.approx(start.body.x0[held], abs=1e-6)
        elif start.steps - last > 20:
            assert path.x[3, held, 1].mean() < path.x[2, held, 1].mean()


def test_known_constants_are_refused_unless_families_tie():
    fit = fitted(1e-6 * np.eye(2))
    assert undetermined(fit, settings()) == []
    with refused("next"):
        choose_next(fit, [experiment()], settings(), NextConfig())
    rival = (Family("neo_hookean", law("neo_hookean")), fit.values)
    lab = NextConfig(candidates=2, kinds=("launch",))
    choice = choose_next(fit, [experiment()], settings(), lab, rivals=[rival], ties=True)
    assert choice.goal == "families" and choice.before == 1.0
    best, other = (min(option.forecast.evidence.values()) for option in choice.options)
    assert best >= other and choice.options[0].after == pytest.approx(math.exp(-best))


def test_candidates_are_ranked_and_written(alone):
    """All kinds together; the record reads back, and progress reaches the end."""
    chosen, calls = settings(), []
    fit = replace(alone.best, covariance=400 * alone.best.covariance)
    lab = NextConfig(candidates=9)
    choice = choose_next(fit, [experiment()], chosen, lab, progress=lambda *each: calls.append(each))
    assert calls[-1] == (9, 9) and len(choice.options) + choice.failed == 9
    assert {option.kind for option in choice.options} == {*lab.kinds}
    after = [option.after for option in choice.options]
    assert after == sorted(after) and after[0] < choice.before and choice.useful
    written = choice.as_dict()
    assert written["candidates"][0]["expected"] == stds(choice.options[0].forecast.fit, chosen)
    for box, room in zip(written["candidates"], choice.as_dict(scale=2.0)["candidates"], strict=True):
        if box["kind"] == "launch":
            assert box["settings"]["velocity"] == [2 * v for v in room["settings"]["velocity"]]
            assert box["settings"]["height"] == 2 * room["settings"]["height"]
            assert box["settings"]["spin"] == room["settings"]["spin"]
        if box["kind"] == "press":
            (platen,), (own,) = box["settings"]["colliders"], room["settings"]["colliders"]
            assert platen["size"] == [2 * length for length in own["size"]]
            assert platen["keyframes"][1][:2] == [
                own["keyframes"][1][0],
                [2 * y for y in own["keyframes"][1][1]],
            ]
        if box["kind"] == "hang":
            assert box["settings"]["clamps"][0]["lowest"] == [
                2 * y for y in room["settings"]["clamps"][0]["lowest"]
            ]


def test_a_record_is_read_and_a_missing_family_refused(alone):
    record = alone.as_dict()
    fit = read_fit(record, settings())
    assert fit.values == pytest.approx(alone.best.values) and (fit.covariance == alone.best.covariance).all()
    with refused("identified.json"):
        read_fit(record, settings(other=law("neo_hookean")))
    assert read_rivals(record, settings(), fit, 2) == []


def linearised(values, covariance=None, spec=HENCKY):
    family = Family("tested", spec)
    each = experiment(std=(0.0,) * 6).residuals(settings())
    assert each.observe(Candidate(family.law_spec(values), np.zeros(NUISANCES)))
    return FamilyRun(family, [each], [len(FRAMES)], settings()).linearise_at(values, covariance).curvature


def test_narrow_differences_are_derivatives():
    """With a tiny covariance along the constants, differences have the width of derivatives, 4 %, on the side with the
    smaller change. For E, whose images change smoothly, the sides differ by less than a third."""
    values = {"E": 3e4, "nu": 0.3}
    derivatives, narrow = (np.diag(linearised(values, each)) for each in (None, np.diag([1e-8, 2e-8])))
    assert (narrow <= derivatives * (1 + 1e-9)).all() and narrow[0] > derivatives[0] * 2 / 3


def test_a_plateau_has_less_information_than_its_edge():
    """A yield stress just below the largest stress of the launch: lower ones change the images, higher ones do not."""
    plastic = law("hencky", "von_mises", yield_stress=12e3)
    values = {"E": 3e4, "nu": 0.3, "yield_stress": 12e3}
    edge = linearised(values, spec=plastic)[2, 2]
    wide = linearised(values, np.diag([1e-8, 1e-8, 1.0]), plastic)[2, 2]
    assert wide < 0.1 * edge
