"""Cameras that differ in times, sizes and exposures in one rollout: lists, loss, fits, motion blur, masks."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image

from neuma_lib.config.identify import IdentifyConfig
from neuma_lib.config.laws import LawConfig
from neuma_lib.config.training import TrainingConfig
from neuma_lib.config.velocity import VelocityConfig
from neuma_lib.coupling import particle_gs
from neuma_lib.coupling.filmed import Filmed
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.fitting.identify import identify
from neuma_lib.fitting.material import PixelLoss
from neuma_lib.fitting.structured_fit import from_frame
from neuma_lib.fitting.velocity import _Flight, _Residuals, estimate_velocity
from neuma_lib.io.images import filmed_steps, load_observation, load_videos, write_transforms
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.methods.spring_gaus.body import SpringBody
from neuma_lib.methods.spring_gaus.fit import fit_springs
from neuma_lib.methods.spring_gaus.network import Springs
from neuma_lib.methods.spring_gaus.options import SpringsConfig
from neuma_lib.methods.spring_gaus.rollout import SpringModel, spring_rollout
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import Trajectory
from neuma_lib.splatting.cameras import Cameras, look_at
from neuma_lib.splatting.observation import Observation, exposed_steps, rendered_steps
from neuma_lib.splatting.rasterizer import rasterize
from tests.support.errors import refused
from tests.support.grounding_scene import MODEL, PRIOR, TRUTH, ball, camera

DT = 1e-3
V0 = (0.4, -1.5, 0.1)
FRAMES = (8, 20, 44, 60)


# ---- lists


def write_list(folder, shots, exposures=(), **shared):
    """A list of frames, (view, step, (width, height)) each; every picture is identified by its red channel."""
    frames = []
    for k, (view, step, (width, height)) in enumerate(shots):
        pixels = np.full((height, width, 4), k, dtype=np.uint8)
        pixels[2:-2, 2:-2, 3] = 255
        Image.fromarray(pixels, "RGBA").save(folder / f"{k}.png")
        pose = np.eye(4)
        pose[0, 3] = view
        own = {"w": width, "h": height, "fl_x": 20.0 + view, "view": view, "step": step}
        frames.append({"file_path": f"{k}.png", "transform_matrix": pose.tolist(), **own})
    for frame in frames:
        if frame["view"] in dict(exposures):
            frame["exposure"] = dict(exposures)[frame["view"]]
    write_transforms(folder / "transforms.json", shared, frames)
    return folder / "transforms.json"


def test_views_that_were_filmed_alike_are_one_observation(tmp_path):
    shots = [(view, step, (16, 12)) for step in (5, 0, 2) for view in (1, 0, 2)]
    path = write_list(tmp_path, shots)
    (video,) = load_videos(path, [2, 0], DT)
    assert video.frames == (0, 2, 5) and video.exposure == (0,) and video.shares is None
    assert video.images[:, :, 0, 0, 0].tolist() == [[5, 4], [8, 7], [2, 1]]
    assert video.cameras.Ks[:, 0, 0].tolist() == [22, 20]
    alone = load_observation(path, [2, 0])
    assert alone.frames == video.frames and torch.equal(alone.images, video.images)
    assert torch.equal(alone.cameras.viewmats, video.cameras.viewmats)


def test_views_of_other_steps_sizes_and_exposures_are_observations_of_their_own(tmp_path):
    shots = [(0, n, (16, 12)) for n in (0, 9, 18)] + [(1, n, (20, 14)) for n in (0, 9, 18)]
    shots += [(view, n, (16, 12)) for n in (4, 13) for view in (2, 3)]
    path = write_list(tmp_path, shots, {0: 2.9e-3, 1: 2.9e-3, 3: 0.0})
    first, second, third = load_videos(path, [0, 1, 2, 3], DT)
    # at step 0 their exposure began before the start
    assert first.frames == second.frames == (9, 18) and third.frames == (4, 13)
    assert first.images.shape == (2, 1, 12, 16, 4) and second.images.shape == (2, 1, 14, 20, 4)
    assert third.images.shape == (2, 2, 12, 16, 4) and third.exposure == (0,)
    assert first.exposure == (-1, 0, 1) and sum(first.shares) == pytest.approx(1)
    assert first.shares[0] == pytest.approx(0.95 / 2.9)
    assert first.images[0, 0, 0, 0, 0] == 1 and second.cameras.width == 20
    videos = load_videos(path, [0, 1, 2, 3], DT)
    assert filmed_steps(path, [0, 1, 2, 3], DT) == rendered_steps(videos) == (4, 8, 9, 10, 13, 17, 18, 19)
    # The length of a step is unknown: pictures of an instant.
    assert [video.exposure for video in load_videos(path, [0, 3])] == [(0,), (0,)]
    with refused(path):
        load_observation(path, [0, 2])
    with refused(f"{path}: view 0"):
        load_videos(path, [0], 1e-5, 9**9)


def test_a_camera_that_moves_is_several_and_a_bad_exposure_is_named(tmp_path):
    path = write_list(tmp_path, [(0, n, (16, 12)) for n in (0, 3, 6)])
    data = json.loads(path.read_text())
    data["frames"][1]["transform_matrix"][1][3] = 0.5
    path.write_text(json.dumps(data))
    assert sorted(video.frames for video in load_videos(path, [0])) == [(0, 6), (3,)]
    data["frames"][1]["exposure"] = "1/250"
    path.write_text(json.dumps(data))
    with refused("1.png): exposure"):
        load_videos(path, [0])


# ---- exposure


@pytest.mark.parametrize("length", [0.0, 0.4, 1.0, 1.6, 3.0, 4.17, 7.9, 16.7, 40.0])
@pytest.mark.parametrize("most", [1, 2, 5, 9, 99])
def test_exposed_steps_are_symmetric_and_as_wide_as_the_exposure(length, most):
    """The blur is centred, and its variance that of the exposure, length^2 / 12, to a quarter of the squared distance
    of its steps: what moving the time within half a distance to its step can change."""
    steps, shares = exposed_steps(length, most)
    assert 1 <= len(steps) <= most and len(steps) % 2 == 1 and sum(shares) == pytest.approx(1)
    assert steps == tuple(-n for n in reversed(steps)) and shares == pytest.approx(shares[::-1])
    if len(steps) > 1:
        spacing = steps[1] - steps[0]
        variance = sum(share * n**2 for n, share in zip(steps, shares, strict=True))
        assert {b - a for a, b in zip(steps, steps[1:], strict=False)} == {spacing}
        assert variance == pytest.approx(length**2 / 12, abs=spacing**2 / 4)
    else:
        assert most < 3 or length <= 1.01


@pytest.mark.parametrize(
    ("options", "where"),
    [
        ({"exposure": (1, 0)}, "observation: exposure"),
        ({"exposure": ()}, "observation: exposure"),
        ({"exposure": (-1, 0), "shares": (0.5, 0.4)}, "observation: shares"),
        ({"exposure": (-3, 0)}, "observation: exposure"),
    ],
)
def test_exposures_that_make_no_sense_are_refused(options, where):
    with refused(where):
        Observation((2, 6), torch.zeros(2, 1, 4, 4, 3), camera(4), **options)


# ---- a filmed ball


def cameras_from(*eyes, size=(24, 20)) -> Cameras:
    eyes = torch.tensor(eyes, dtype=torch.float64)
    views = look_at(eyes, torch.tensor([0.5, 0.25, 0.5]).double(), torch.tensor([0.0, 1.0, 0.0]).double())
    K = torch.tensor([[1.8 * size[0], 0, size[0] / 2], [0, 1.8 * size[0], size[1] / 2], [0, 0, 1]])
    return Cameras(views, K.double().repeat(len(eyes), 1, 1), *size)


LEFT, RIGHT = (0.5, 0.3, 2.0), (2.0, 0.4, 0.5)


def blank(cameras, frames, exposure=(0,), shares=None) -> Observation:
    images = torch.zeros(len(frames), len(cameras), cameras.height, cameras.width, 3, dtype=torch.float64)
    return Observation(frames, images, cameras, exposure, shares)


def filmed(body, video: Observation, spec=TRUTH, v0=V0, masks=False) -> Observation:
    """The video of a ball under a law; its pixels as bytes with a mask, if so asked."""
    steps = rendered_steps([video])
    with torch.no_grad():
        path = rollout(MODEL, analytic_law(spec, MODEL.dt), body.state(v0), steps=steps[-1], frames=steps)
        colour, cover = (
            film(film.states(path.x), film.states(path.F))
            for film in (
                Filmed(body.particle_gs(video.cameras), video, steps, kind) for kind in ("colour", "masks")
            )
        )
    if not masks:
        return replace(video, images=colour)
    straight = (colour - (1 - cover)) / cover.clamp(min=1e-3)
    pixels = torch.cat([straight.clamp(0, 1), cover], dim=-1)
    return replace(video, images=(255 * pixels).round().byte())


def evaluated(loss, steps, spec=PRIOR):
    """Losses of a rollout, and their gradients with respect to its states."""
    with torch.no_grad():
        path = rollout(MODEL, analytic_law(spec, MODEL.dt), ball().state(V0), steps=steps[-1], frames=steps)
    x, F = path.x.requires_grad_(), path.F.requires_grad_()
    value = loss(Trajectory(steps, x, path.v, F, path.C))
    weight = torch.linspace(1, 2, len(value), dtype=torch.float64)
    return (value.detach(), *torch.autograd.grad(value, (x, F), weight, allow_unused=True))


@pytest.mark.parametrize("compare", ["colour", "masks"])
@pytest.mark.parametrize("exposure", [(0,), (-2, 0, 2)])
def test_views_in_one_observation_are_the_same_as_one_each(compare, exposure):
    body = ball()
    together = filmed(body, blank(cameras_from(LEFT, RIGHT), FRAMES, exposure), masks=True)
    separate = [
        replace(together, images=together.images[:, [v]], cameras=together.cameras[v]) for v in (1, 0)
    ]
    one, two = (PixelLoss(body, videos, compare=compare) for videos in (together, separate))
    assert one.frames == two.frames and one.steps == two.steps
    for mine, twin in zip(evaluated(two, two.steps), evaluated(one, one.steps), strict=True):
        assert torch.allclose(mine, twin, rtol=1e-10, atol=1e-12 * float(twin.abs().max()))


def test_an_exposure_of_one_step_changes_no_bit():
    body = ball()
    plain = filmed(body, blank(cameras_from(LEFT), FRAMES), masks=True)
    instant = replace(plain, exposure=(0,), shares=(1.0,))
    for mine, twin in zip(
        evaluated(PixelLoss(body, [instant]), FRAMES), evaluated(PixelLoss(body, plain), FRAMES), strict=True
    ):
        assert torch.equal(mine, twin)


def unlike(body, masks=False, spec=TRUTH) -> list[Observation]:
    """Two cameras with other times, sizes and exposures; they have one frame in common."""
    return [
        filmed(body, blank(cameras_from(LEFT), FRAMES, (-2, 0, 2), (0.3, 0.4, 0.3)), spec, masks=masks),
        filmed(body, blank(cameras_from(RIGHT, size=(16, 18)), (14, 20, 52), (-1, 0, 1)), spec, masks=masks),
    ]


@pytest.mark.parametrize("compare", ["colour", "masks"])
def test_loss_and_gradient_of_unlike_cameras(compare, monkeypatch):
    """A frame's loss is the mean over its pictures; the gradient is that of differences, without thresholds of opacity,
    at which images jump. A larger step of the difference would change the order of two Gaussians in depth."""
    smooth = partial(rasterize, alpha_min=0.0, alpha_max=2.0, transmittance_min=0.0)
    monkeypatch.setattr(particle_gs, "rasterize", smooth)
    body = ball()
    videos = unlike(body, masks=True)
    loss = PixelLoss(body, videos, compare=compare)
    assert loss.frames == (8, 14, 20, 44, 52, 60)
    assert loss.steps == (6, 8, 10, 13, 14, 15, 18, 19, 20, 21, 22, 42, 44, 46, 51, 52, 53, 58, 60, 62)
    value, in_x, in_F = evaluated(loss, loss.steps)
    first, second = (PixelLoss(body, video, compare=compare) for video in videos)
    a, b = (evaluated(each, each.steps)[0] for each in (first, second))
    expected = torch.stack([a[0], b[0], (a[1] + b[1]) / 2, a[2], b[2], a[3]])
    assert torch.allclose(value, expected, rtol=1e-10) and (value > 1e-9).all()
    with torch.no_grad():
        law = analytic_law(PRIOR, MODEL.dt)
        path = rollout(MODEL, law, body.state(V0), steps=loss.steps[-1], frames=loss.steps)
    weight = torch.linspace(1, 2, len(value), dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)
    for name, gradient in (("x", in_x), ("F", in_F)):
        direction = torch.randn(gradient.shape, generator=generator, dtype=torch.float64)
        sides = []
        for h in (1e-7, -1e-7):
            moved = replace(path, **{name: getattr(path, name) + h * direction})
            sides.append(float(weight @ loss(moved)))
        slope = (sides[0] - sides[1]) / 2e-7
        assert slope != 0 and float((gradient * direction).sum()) == pytest.approx(slope, rel=1e-4)


def test_parts_of_a_loss_keep_the_values_of_their_frames():
    """Some of the frames, in batches of one, and from a later start: every value stays what it was."""
    body = ball()
    loss = PixelLoss(body, unlike(body))
    law = analytic_law(TRUTH | PRIOR, MODEL.dt)
    with torch.no_grad():
        path = rollout(MODEL, law, body.state(V0), steps=loss.steps[-1], frames=loss.steps)
        whole = loss(path)
        for keep in ([0, 1], [1], [2, 3, 5]):
            part = replace(loss.select(keep), frames_per_batch=1)
            assert part.frames == tuple(loss.frames[k] for k in keep)
            assert torch.allclose(part(path.at(part.steps)), whole[keep], rtol=1e-12)
        # step 42 is exposed for the frame at 44, and 22 for the one at 20
        start, later = from_frame(body.state(V0), loss, path, 3)
        assert later.frames == (44 - 20, 52 - 20, 60 - 20) and torch.equal(start.x, path.at([20]).x[0])
        again = rollout(MODEL, law, start, steps=later.steps[-1], frames=later.steps)
        assert torch.allclose(later(again), whole[3:], rtol=1e-6)
        with refused("pixel loss"):
            loss(path.at(loss.frames))


def test_what_lies_under_a_transparent_pixel_does_not_count_and_masks_have_no_colours():
    body = ball()
    (video, _) = unlike(body, masks=True)
    elsewhere, repainted = video.images.clone(), video.images.clone()
    elsewhere[..., :3][video.images[..., 3] == 0] = 77
    repainted[..., :3] = 255 - repainted[..., :3]
    assert (elsewhere != video.images).any()
    for compare, other, same in (
        ("colour", elsewhere, True), ("masks", elsewhere, True), ("masks", repainted, True),
        ("colour", repainted, False),
    ):  # fmt: skip
        one, two = (PixelLoss(body, each, compare=compare) for each in (video, replace(video, images=other)))
        assert torch.equal(evaluated(one, one.steps)[0], evaluated(two, two.steps)[0]) == same
    renders = PixelLoss(body, unlike(body), compare="masks")
    with refused("observation: images"):
        evaluated(renders, renders.steps)


# ---- identification and velocity


def known(body, v0) -> InitialMotion:
    centre = (body.mass @ body.x0 / body.mass.sum()).numpy()
    return InitialMotion(np.array(v0), np.zeros(3), centre, np.eye(3), np.zeros(6))


def law(E=3e4, nu=0.3) -> dict:
    return {"elasticity": {"name": "hencky", "E": E, "nu": nu}, "plasticity": {"name": "identity"}}


def identified(body, videos, v0=V0, squares=(8, 24), **options):
    chosen = IdentifyConfig(
        families={"hencky": LawConfig(**law(6e4))}, pyramid=squares, pose_tolerance=0.0,
        covariance_from="elastic", gaussian_motion="mean", **options,
    )  # fmt: skip
    return identify(MODEL, known(body, v0), body, videos, chosen).best


def test_views_apart_identify_what_they_do_together():
    """Constants, loss and covariance of one observation of two views and of two of one view, to rounding."""
    body, frames = ball(), tuple(range(8, 97, 8))
    together = filmed(body, blank(cameras_from(LEFT, RIGHT), frames), law())
    noise = torch.randn(
        together.images.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )
    together = replace(together, images=together.images + 0.01 * noise)
    separate = [
        replace(together, images=together.images[:, [v]], cameras=together.cameras[v]) for v in (0, 1)
    ]
    one, two = (identified(body, videos, iterations=2) for videos in (together, separate))
    assert two.values == pytest.approx(one.values, rel=1e-6)
    assert two.loss == pytest.approx(one.loss, rel=1e-8)
    np.testing.assert_allclose(two.covariance, one.covariance, rtol=1e-3)


@pytest.mark.parametrize("compare", ["colour", "masks"])
def test_unlike_cameras_identify_the_truth(compare):
    """Staggered times, other sizes and exposures, colours or masks of 8 bits: stiffness to 2 %, from twice of it."""
    body = ball()
    videos = [
        filmed(body, blank(cameras_from(LEFT), tuple(range(8, 97, 8)), (-2, 0, 2)), law(), masks=True),
        filmed(
            body, blank(cameras_from(RIGHT, size=(32, 28)), tuple(range(12, 97, 12)), (-1, 0, 1)), law(), masks=True
        ),
    ]  # fmt: skip
    best = identified(body, videos, compare=compare)
    assert best.values["E"] == pytest.approx(3e4, rel=0.02)
    assert best.values["nu"] == pytest.approx(0.3, abs=0.02)


def test_motion_blur_that_is_rendered_does_not_bias_the_stiffness():
    """A fall of 3 m/s, with images exposed for half of the time until the next.

    With a render at every second step of the exposure, the stiffness is estimated to 0.2 %. With instantaneous images,
    its error is at least five times and the residual a hundred times larger.
    """
    body, v0, frames = ball(), (0.5, -3.0, 0.0), tuple(range(16, 105, 16))
    seen = filmed(body, blank(camera(24), frames, *exposed_steps(8.0, 99)), law(), v0)
    steps, shares = exposed_steps(8.0, 5)
    assert len(seen.exposure) == 9 and steps == (-4, -2, 0, 2, 4)
    sharp = identified(body, replace(seen, exposure=(0,), shares=None), v0)
    blurred = identified(body, replace(seen, exposure=steps, shares=shares), v0)
    assert blurred.values["E"] == pytest.approx(3e4, rel=2e-3)
    assert abs(sharp.values["E"] / 3e4 - 1) > 1e-2
    assert blurred.loss < 0.01 * sharp.loss


def test_views_apart_have_the_velocity_residuals_that_they_have_together():
    body, steps = ball(0.45), (0, 8, 16)
    together = filmed(body, blank(cameras_from(LEFT, RIGHT, size=(16, 14)), steps, (0, 1)), law())
    separate = [
        replace(together, images=together.images[:, [v]], cameras=together.cameras[v]) for v in (0, 1)
    ]
    flight = _Flight(MODEL, analytic_law(law(), MODEL.dt), body, (1, 9, 17))
    unknowns = np.array([0.4, -1.4, 0.2, 0.1, 0, 0, 0.05, 0, 0.1, 0, 0])
    flight.simulate(unknowns, rendered_steps(separate))
    one, two = (_Residuals(flight, videos, 0.02).linearise(unknowns) for videos in ((together,), separate))
    assert two.cost == pytest.approx(one.cost, rel=1e-10) and two.rms == pytest.approx(one.rms, rel=1e-10)
    np.testing.assert_allclose(two.curvatures, one.curvatures, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(two.scores, one.scores, rtol=1e-8, atol=1e-9)


@pytest.mark.slow
def test_velocity_from_staggered_cameras_that_blur():
    """The velocity, its depth too, to a centimetre a second, from frames whose exposure ends before contact."""
    body, v0 = ball(0.45), (0.3, -2.0, 0.2)
    videos = [
        filmed(body, blank(cameras_from(LEFT), (2, 10, 18, 26, 90), (-2, 0, 2)), law(), v0),
        filmed(body, blank(cameras_from(RIGHT, size=(20, 16)), (5, 13, 21, 29, 90), (-1, 0, 1)), law(), v0),
    ]
    estimate = estimate_velocity(MODEL, analytic_law(law(), MODEL.dt), body, videos, VelocityConfig(frames=4))
    assert max(estimate.frames) <= 29 and {2, 5} & set(estimate.frames)
    np.testing.assert_allclose(estimate.v0, v0, atol=0.01)


@pytest.mark.parametrize("truncated", [True, False])
def test_springs_are_fitted_to_staggered_cameras_whose_exposures_overlap(truncated):
    """Frame by frame too, where a frame's exposure begins before that of the frame before it has ended."""
    body, v0 = ball(), (0.0, -1.5, 0.0)
    anchored = SpringBody.of(body.x0, 60, 12, 6, 0.5, 12)
    start, model = body.state(v0), SpringModel.of(MODEL)
    guess, truth = (Springs.of_modulus(anchored.network, E, 1000.0, 0.1) for E in (2e5, 1e5))
    videos = [
        blank(cameras_from(LEFT), (30, 40, 55), (-3, 0, 3)),
        blank(cameras_from(RIGHT, size=(16, 18)), (33, 42, 50), (-2, 0, 2)),
    ]
    steps = rendered_steps(videos)
    with torch.no_grad():
        x, v, _ = spring_rollout(model, truth, *anchored.start(start), steps)
        path = anchored.path(steps, x, v)
        for k, video in enumerate(videos):
            film = Filmed(body.particle_gs(video.cameras), video, steps)
            videos[k] = replace(video, images=film(film.states(path.x), film.states(path.F)))
    loss = PixelLoss(body, videos)
    assert loss.steps == steps and float(loss(path).max()) < 1e-20
    how = SpringsConfig(truncated=truncated, lr_springs=0.05, learn_gap=False)
    problem = (model, anchored, guess, start, loss, TrainingConfig(iterations=12), how)
    fitted = fit_springs(*problem, log=lambda _: None)
    assert fitted.stable and fitted.best_loss < 0.1 * fitted.history.loss[0]
