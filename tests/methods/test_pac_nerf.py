"""PAC-NeRF's velocity and constants: their gradients from constants to pixels, recovery of known truths, resuming."""

import math

import pytest
import torch

from benchmarks import pac_nerf as benchmark
from benchmarks.pac_nerf import BOUNDS, DENSITY, MIN_OPACITY, MODEL, spotted_ball
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.mechanics.catalogue import lame
from neuma_lib.methods.pac_nerf import rendering
from neuma_lib.methods.pac_nerf.carried_field import CarriedField
from neuma_lib.methods.pac_nerf.families import FamilyConstants, choose_family
from neuma_lib.methods.pac_nerf.fit import Video, fit_pac_nerf, spread
from neuma_lib.methods.pac_nerf.io import save_field
from neuma_lib.methods.pac_nerf.options import PacFamilyConfig, PacNerfConfig
from neuma_lib.methods.pac_nerf.rendering import camera_rays
from neuma_lib.sim.rollout import rollout
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.observation import Observation
from tests.support.errors import refused
from tests.support.radiance_scenes import kept_for_gradient

V0 = torch.tensor(benchmark.V0, dtype=torch.float64)
FRAMES = tuple(range(0, 145, 8))
SMALL = PacNerfConfig(
    particles=400, followed=8, velocity_iterations=20, iterations_contact=15, iterations_all=30, max_frames=8
)
ELASTIC = PacFamilyConfig(elasticity={"name": "neo_hookean", "E": 1e4, "nu": 0.3}, fitted=("E", "nu"))
PLASTIC = PacFamilyConfig(
    elasticity={"name": "hencky", "E": 1e5, "nu": 0.25},
    plasticity={"name": "von_mises", "yield_stress": 3e3},
    fitted=("yield_stress",),
)
SAND = PacFamilyConfig(
    elasticity={"name": "hencky", "E": 3e5, "nu": 0.25},
    plasticity={"name": "drucker_prager", "friction_angle": 15},
    fitted=("friction_angle",),
)
HONEY = PacFamilyConfig(
    elasticity={"name": "hencky", "E": 1e5, "nu": 0.3},
    plasticity={"name": "viscous_flow", "viscosity": 20},
    fitted=("viscosity",),
)


def ball():
    return spotted_ball(torch.float64)


def body(settings=SMALL):
    return CarriedField(ball(), 1.0, MIN_OPACITY, settings, DENSITY)


def film(carried, spec):
    """The video of a body with this law, launched with V0. The particles of the field move."""
    return benchmark.film(carried.field, carried.rendered, spec, FRAMES, benchmark.cameras(24, torch.float64))


def contact(carried):
    """Step of the last frame before contact."""
    return benchmark.contact(carried.moving, FRAMES)


def changed(family, **values):
    """The specification of a family's law with other constants."""
    spec = FamilyConstants(family, values).specification()
    assert all(
        any(part.get(name) == pytest.approx(value) for part in spec.values())
        for name, value in values.items()
    )
    return spec


@pytest.fixture(scope="module")
def carried():
    return body()


@pytest.mark.parametrize("family", [ELASTIC, PLASTIC, SAND, HONEY], ids=lambda f: f.fitted[0])
def test_gradient_of_constants_and_velocity_against_differences(family, carried):
    """From pictures of a bounce, along rays and through nodes, particles that follow, steps and laws."""
    constants, video = FamilyConstants(family), Video(film(carried, changed(family)))
    frames = [contact(carried) // 8 + 4]

    def loss(velocity):
        law = constants.law(MODEL.dt)
        x = rollout(
            MODEL, law, carried.state(velocity), steps=FRAMES[frames[0]], frames=[FRAMES[frames[0]]]
        ).x
        return 1e3 * video.error(carried, carried.positions(x)[0], frames[0], 1, None, None)

    velocity = (V0 + 0.05).requires_grad_()
    leaves = [*constants.parameters(), velocity]
    with torch.no_grad():  # away from the truth, where the gradient is 0
        for parameter in constants.parameters():
            parameter += 0.02 * parameter.abs()
    exact = torch.autograd.grad(loss(velocity), leaves)
    for leaf, gradient in zip(leaves, exact, strict=True):
        direction, h = torch.ones_like(leaf), 1e-6
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                leaf += sign * h * direction
                values.append(float(loss(velocity)))
                leaf -= sign * h * direction
        difference = (values[0] - values[1]) / (2 * h)
        assert abs(difference) > 1e-6
        assert float((gradient * direction).sum()) == pytest.approx(difference, rel=1e-4)


class TestMemory:
    """Images are rendered in pieces, and remain bytes until they are compared."""

    @staticmethod
    def video(carried, size):
        """A picture of the body where it is in three views, and one of noise, as files have them."""
        cameras = benchmark.cameras(size, torch.float64)
        drawn = torch.stack([carried.field.draw(cameras, view, carried.rendered) for view in range(3)])
        opaque = torch.full((3, size, size, 1), 255, dtype=torch.uint8)
        rgba = torch.cat([(255 * drawn.clamp(0, 1)).byte(), opaque], dim=-1)
        other = torch.randint(256, rgba.shape, generator=torch.Generator().manual_seed(0)).byte()
        return Observation((0, 8), torch.stack([rgba, other]), cameras)

    @staticmethod
    def error(carried, video):
        """Loss of the body a little aside, its gradient in the positions, and the bytes that were kept for it."""
        x = (carried.rendered.x + 0.01).requires_grad_()
        with kept_for_gradient() as kept:
            error = video.error(carried, x, 0, 1, None, None, 3)
            error.backward()
        return float(error.detach()), x.grad, kept[0]

    def test_a_picture_in_pieces_has_the_same_loss_and_gradient(self, carried, monkeypatch):
        video, results = Video(self.video(carried, 24)), []
        for most in (10**9, 300, 1):
            monkeypatch.setitem(rendering.POINTS_AT_ONCE, "cpu", most)
            results.append([*self.error(carried, video)[:2], carried.field.draw(video.views[0].cameras, 0)])
        (loss, gradient, picture), *others = results
        assert loss > 1e-4 and gradient.abs().max() > 1e-6
        for other in others:
            assert other[0] == pytest.approx(loss, rel=1e-12)
            assert (other[1] - gradient).abs().max() < 1e-11 * gradient.abs().max()
            assert (other[2] - picture).abs().max() < 1e-13

    def test_memory_does_not_grow_with_the_picture(self, carried, monkeypatch):
        """Nine times as many rays; rendered at once they keep over six times as much."""
        videos, kept = [Video(self.video(carried, size)) for size in (24, 72)], {}
        for most in (500, 10**9):
            monkeypatch.setitem(rendering.POINTS_AT_ONCE, "cpu", most)
            kept[most] = [self.error(carried, video)[2] for video in videos]
        assert kept[500][1] < 1.05 * kept[500][0] < kept[10**9][0]
        assert kept[10**9][1] > 6 * kept[10**9][0]

    def test_a_video_stays_in_bytes(self, carried):
        seen = self.video(carried, 24)
        video = Video(seen)
        for k in range(2):
            for view in range(3):
                assert torch.equal(video.image(k, view), seen.colours()[k, view].view(-1, 3))
        memory = {view.images.untyped_storage().data_ptr() for view in video.views}
        assert memory == {seen.images.untyped_storage().data_ptr()}


@pytest.fixture(scope="module")
def elastic(carried):
    """A fit of E and nu from a decade off."""
    truth = changed(ELASTIC, E=1e5, nu=0.3)
    constants = FamilyConstants(ELASTIC)
    return fit_pac_nerf(
        MODEL, carried, film(carried, truth), contact(carried), constants, SMALL, log=lambda _: None
    )


def test_velocity_is_found_before_contact(elastic):
    """To what a step of L-BFGS may still change when it ends, a few times."""
    assert (elastic.velocity - V0).abs().max() < 0.01


def test_youngs_modulus_is_found_from_a_decade_off(elastic):
    E = float(elastic.constants.values()["E"].detach())
    assert elastic.history.constants["E"][0] == pytest.approx(1e4)
    assert E == pytest.approx(1e5, rel=0.1)
    assert elastic.history.loss[-1] < 0.05 * elastic.history.loss[0]


def test_poissons_ratio_is_recovered(elastic):
    assert float(elastic.constants.values()["nu"].detach()) == pytest.approx(0.3, abs=0.05)


def test_poissons_ratio_waits_for_the_modulus(elastic):
    curve = elastic.history.constants["nu"]
    assert set(curve[: SMALL.iterations_contact + 1]) == {curve[0]} and curve[-1] != curve[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", list(BOUNDS))
def test_constants_of_every_family_are_recovered_from_its_published_guess(name, loaded):
    """With default settings, within the bounds of docs/systems.md; see benchmarks/pac_nerf.py."""
    settings = loaded.pac_nerf.model_copy(update=benchmark.SMALL)
    fit = benchmark.recover(name, settings.families[name], settings, log=lambda _: None)
    fitted = fit.constants.fitted_numbers()
    for key, bound in BOUNDS[name].items():
        assert benchmark.error(key, benchmark.TRUTHS[name][key], fitted[key]) < bound


def test_resumes_bit_for_bit(carried, tmp_path):
    short = SMALL.model_copy(update=dict(iterations_contact=2, iterations_all=4, save_every=2, pixels=100))
    video = film(carried, changed(ELASTIC, E=1e5))

    def fitted(**how):
        return fit_pac_nerf(
            MODEL,
            carried,
            video,
            contact(carried),
            FamilyConstants(ELASTIC),
            short,
            3,
            log=lambda _: None,
            **how,
        )

    def kill(step, steps, loss):
        if step == 5:
            raise KeyboardInterrupt

    whole, state = fitted(), tmp_path / "state.pt"
    with pytest.raises(KeyboardInterrupt):
        fitted(checkpoint=Checkpoint(state, {}), progress=kill)
    seen = []
    again = fitted(checkpoint=Checkpoint(state, {}), progress=lambda step, *_: seen.append(step))
    assert seen == [5, 6] and torch.equal(whole.velocity, again.velocity)
    assert again.history.loss == whole.history.loss
    assert again.constants.specification() == whole.constants.specification()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_agrees(carried):
    short = SMALL.model_copy(update=dict(velocity_iterations=2, iterations_contact=0, iterations_all=2))
    video, results = film(carried, changed(ELASTIC, E=1e5)), []
    for device in ("cpu", "cuda"):
        own = CarriedField(ball().to(device), 1.0, 1e-3, short, 1000.0)
        seen = video.to(torch.float64, device)
        fit = fit_pac_nerf(
            MODEL, own, seen, contact(carried), FamilyConstants(ELASTIC), short, log=lambda _: None
        )
        results.append([*fit.velocity.tolist(), *fit.history.loss, *fit.history.constants["E"]])
    assert results[1] == pytest.approx(results[0], rel=1e-5)


def test_steps_are_halved_where_a_law_is_too_stiff(carried):
    short = SMALL.model_copy(update=dict(iterations_contact=0, iterations_all=2, velocity_iterations=3))
    video = film(carried, changed(ELASTIC, E=1e5))
    stiff, messages = FamilyConstants(ELASTIC, {"E": 8e6}), []
    fit = fit_pac_nerf(MODEL, carried, video, contact(carried), stiff, short, log=messages.append)
    assert fit.history.halvings[0] == 2 and any("0.00025 s" in line for line in messages)
    with refused("pac_nerf.families"):
        stiffer = FamilyConstants(ELASTIC, {"E": 1e12})
        fit_pac_nerf(MODEL, carried, video, contact(carried), stiffer, short, log=messages.append)


def test_constants_are_stored_as_published():
    constants = FamilyConstants(ELASTIC, {"E": 316228.0, "nu": 0.25})
    assert float(constants.stored["E"].detach()) == pytest.approx(5.5, abs=1e-6)
    assert float(constants.stored["nu"].detach()) == pytest.approx(0.45 * math.atanh(0.25 / 0.45))
    spec = constants.specification()["elasticity"]
    assert spec["E"] == pytest.approx(316228) and spec["nu"] == pytest.approx(0.25)
    with torch.no_grad():
        constants.stored["nu"].fill_(100.0)
    assert constants.specification()["elasticity"]["nu"] == pytest.approx(0.45)


def test_elasticity_and_plasticity_share_their_moduli():
    law = FamilyConstants(PLASTIC.model_copy(update={"fitted": ("mu", "kappa", "yield_stress")})).law(1e-3)
    assert law.elasticity.values["E"] is law.plasticity.values["E"]
    mu, lam = lame(*(law.elasticity.values[name].detach() for name in ("E", "nu")))
    assert float(mu) == pytest.approx(1e5 / 2.5) and float(lam + 2 * mu / 3) == pytest.approx(1e5 / 1.5)


def test_published_guesses_are_those_of_the_authors(loaded):
    """Their settings of the benchmark, in this project's conventions (docs/systems.md)."""
    families = loaded.pac_nerf.families

    def guess(name):
        spec = families[name].plain()
        mu, lam = lame(spec["elasticity"]["E"], spec["elasticity"]["nu"])
        return {**spec["elasticity"], **spec["plasticity"], "mu": mu, "kappa": lam + 2 * mu / 3}

    assert guess("elastic")["E"] == pytest.approx(10**5.5, rel=1e-5) and guess("elastic")["nu"] == 0.25
    clay = guess("plasticine")
    assert (clay["E"], clay["nu"]) == (1e4, 0.25)
    assert clay["yield_stress"] == pytest.approx(math.sqrt(2 / 3) * 1000, rel=1e-4)
    sand = guess("sand")
    assert (sand["E"], sand["nu"], sand["friction_angle"]) == (1e6, 0.3, 10)
    cream = guess("non_newtonian")
    assert cream["kappa"] == pytest.approx(1e5, rel=1e-3) and cream["mu"] == pytest.approx(100, rel=1e-3)
    assert cream["viscosity"] == 1 / 2 and cream["yield_stress"] == pytest.approx(
        math.sqrt(2 / 3) * 10, rel=1e-4
    )
    water = guess("newtonian")
    assert water["kappa"] / 7 == pytest.approx(1e4, rel=1e-4) and 2 * water["viscosity"] == 10


@pytest.mark.parametrize(
    "prior, family", [("jelly", "elastic"), ("plasticine", "plasticine"), ("sand", "sand")]
)
def test_family_is_that_of_the_prior(prior, family, loaded):
    law = loaded.priors.laws[prior].plain()
    name, constants = choose_family(loaded.pac_nerf, law)
    assert name == family
    by_prior = loaded.pac_nerf.model_copy(update={"guesses": "prior"})
    _, constants = choose_family(by_prior, law)
    spec = constants.specification()
    assert spec["elasticity"]["E"] == pytest.approx(law["elasticity"]["E"])
    own = {key: value for key, value in law["plasticity"].items() if key != "name"}
    assert all(spec["plasticity"][key] == pytest.approx(value) for key, value in own.items())


def test_bad_input_is_named(carried, loaded):
    with refused("pac_nerf.family"):
        choose_family(loaded.pac_nerf, None)
    with refused("pac_nerf.family"):
        choose_family(loaded.pac_nerf.model_copy(update={"family": "honey"}), None)
    foam = {"elasticity": {"name": "hencky"}, "plasticity": {"name": "crushable_foam"}}
    with refused("pac_nerf.families"):
        choose_family(loaded.pac_nerf, foam)
    with refused("pac_nerf.families.nu"):
        FamilyConstants(ELASTIC, {"nu": 0.48})
    video = film(carried, changed(ELASTIC, E=1e5))
    with refused("frames"):
        fit_pac_nerf(MODEL, carried, video, 0, FamilyConstants(ELASTIC), SMALL)
    last = len(video.frames) - 1
    with refused("frames", problem=f"{last} before and 0 after contact"):
        fit_pac_nerf(MODEL, carried, video, video.frames[last], FamilyConstants(ELASTIC), SMALL)
    with pytest.raises(ValueError, match="fitted"):
        PacFamilyConfig(elasticity={"name": "hencky", "E": 1e5, "nu": 0.3}, fitted=("yield_stress",))
    with pytest.raises(ValueError, match="not both"):
        PacFamilyConfig(elasticity={"name": "hencky", "E": 1e5, "nu": 0.3}, fitted=("E", "mu"))


def test_frames_are_spread_evenly():
    assert spread(range(5), 9) == [0, 1, 2, 3, 4]
    assert spread(range(12), 3) == [3, 7, 11]


class TestOwnParticles:
    """The preset that is evaluated on the particles of the field, and its images."""

    CAMERAS = benchmark.cameras(24, torch.float64)

    def rendered(self, carried, x, **how):
        """Pictures (T, V, H, W, 3) of states x (T, A, 3) of what moves."""
        return carried.particle_gs(self.CAMERAS, **how)(x)

    def test_nothing_moved_shows_the_field_itself(self, carried):
        """At t = 0 the pictures are those of the field's particles where they were drawn, bit for bit."""
        (images,) = self.rendered(carried, carried.moving.x[None])
        for view, image in enumerate(images):
            assert torch.equal(image, carried.field.draw(self.CAMERAS, view, carried.rendered))
        assert images.amin() < 0.6 and images.amax() <= 1

    def test_a_rigid_motion_by_voxels_is_one_of_the_cameras(self, carried):
        """Nodes are multiples of the voxel, so that a shift by some of them is the same as moving the cameras back."""
        shift = carried.rendered.voxel * torch.tensor([2.0, -1.0, 3.0], dtype=torch.float64)
        x = carried.moving.x
        (moved,) = self.rendered(carried, (x + shift)[None])
        viewmats = self.CAMERAS.viewmats.clone()
        viewmats[:, :3, 3] += viewmats[:, :3, :3] @ shift
        behind = Cameras(viewmats, self.CAMERAS.Ks, self.CAMERAS.width, self.CAMERAS.height)
        (still,) = carried.particle_gs(behind)(x[None])
        assert torch.allclose(moved, still, atol=1e-9)
        (before,) = self.rendered(carried, x[None])
        assert (moved - before).abs().max() > 0.1

    def test_background_shows_where_the_body_is_not(self, carried):
        """What a white and a black background differ by is the light that comes through: the mask of image metrics."""
        x = carried.moving.x[None]
        over_white, over_black = (self.rendered(carried, x, background=(c, c, c)) for c in (1.0, 0.0))
        through = (over_white - over_black).mean(-1)[0, 1].flatten()
        rays = camera_rays(self.CAMERAS, 1)
        _, passed = carried.field.render(*carried.rendered.seen(), *rays)
        assert torch.allclose(through, passed, atol=1e-12) and passed.amin() < 0.3 and passed.amax() == 1
        assert torch.equal(self.rendered(carried, x), over_white)

    def test_frames_are_rendered_in_batches_alike(self, carried):
        x = carried.moving.x + torch.tensor([[[0.0]], [[0.013]], [[0.05]]], dtype=torch.float64)
        F = torch.eye(3).expand(*x.shape, 3)
        renderer = carried.particle_gs(self.CAMERAS[0])
        parts = list(renderer.batches(x, F, size=2))
        assert [part for part, _ in parts] == [slice(0, 2), slice(2, 3)]
        assert torch.equal(torch.cat([images for _, images in parts]), renderer(x))
        assert len(list(renderer.batches(x, F))) == 3

    def test_its_own_particles_make_the_video_that_it_was_fitted_to(self, carried):
        """The loss of the fit equals that of these images, with the fitted law, initial motion and particles."""
        spec = changed(ELASTIC, E=1e5)
        law = FamilyConstants(ELASTIC, {"E": 1e5}).law(MODEL.dt)
        video, k = film(carried, spec), len(FRAMES) - 1
        state = carried.state(V0.tolist())
        with torch.no_grad():
            x = rollout(MODEL, law, state, steps=FRAMES[k], frames=[FRAMES[k]]).x
        (images,) = carried.particle_gs(video.cameras)(x)
        errors = (images - video.colours([k])[0]).square().flatten(1).sum(1) / images[0, ..., 0].numel()
        for view, error in enumerate(errors):
            loss = Video(video).error(carried, carried.positions(x)[0], k, view, None, None)
            assert float(error) == pytest.approx(float(loss), rel=1e-9)

    def test_tracers_are_carried_by_particles_of_weighed_mass_and_stiffness(self, carried):
        """In free flight all that is in the body, tracers too, falls alike, whatever a particle weighs."""
        state, law = carried.state(V0), FamilyConstants(ELASTIC).law(MODEL.dt)
        assert torch.equal(state.mass, carried.moving.opacities * DENSITY * carried.moving.volume)
        assert torch.equal(state.vol0, carried.moving.opacities**3 * carried.moving.volume)
        assert float(state.mass.max() / state.mass.min()) > 2, "a shell that is lighter than the core"
        steps = 40
        tracers = carried.moving.x[:50].mean(0) + 0.02 * torch.eye(3, dtype=torch.float64)
        with torch.no_grad():
            path = rollout(MODEL, law, state, steps=steps, frames=[steps], tracers=tracers)
        fallen = path.tracers[-1] - tracers
        assert torch.allclose(fallen, (path.x[-1] - state.x).mean(0).expand(3, 3), atol=1e-4)

    def test_a_file_gives_the_particles_that_the_fit_had(self, tmp_path):
        carried = CarriedField(ball().float(), 1.0, MIN_OPACITY, SMALL, DENSITY)
        save_field(tmp_path / "field.safetensors", carried.field, {})
        own = {"spacing": 1.0, "min_opacity": MIN_OPACITY, "settings": SMALL.plain()}
        loaded = CarriedField.load(tmp_path / "field.safetensors", own, DENSITY)
        assert torch.equal(loaded.moving.x, carried.moving.x) and torch.equal(loaded.mass, carried.mass)
        x = carried.moving.x[None] + 0.01
        assert torch.equal(loaded.particle_gs(self.CAMERAS)(x), self.rendered(carried, x))

    @pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
    def test_cuda_shows_the_same(self, carried):
        on_gpu = CarriedField(ball().cuda(), 1.0, MIN_OPACITY, SMALL, DENSITY)
        x = carried.moving.x[None] + 0.01
        assert torch.allclose(
            self.rendered(on_gpu, x).cpu(), self.rendered(carried, x), atol=1e-9
        )  # x is moved to the device of the field

    def test_bad_input_is_named(self, carried):
        with refused("rollout"):
            self.rendered(carried, torch.zeros(1, 7, 3, dtype=torch.float64))
