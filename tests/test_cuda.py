"""The CPU and a CUDA GPU run the same functions and agree. Skipped without a GPU."""

import copy
import gc
from dataclasses import replace

import pytest
import torch
import warp as wp

from neuma_lib.config.binding import BindingConfig
from neuma_lib.config.training import TrainingConfig
from neuma_lib.config.velocity import VelocityConfig
from neuma_lib.coupling.particle_binding import bind_two_pass
from neuma_lib.coupling.particle_gs import ParticleGS
from neuma_lib.fitting.material import PixelLoss, train_material
from neuma_lib.fitting.velocity import estimate_velocity
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.mechanics.structured import FORMS, structured_law
from neuma_lib.methods.pac_nerf.lattice import from_particles
from neuma_lib.methods.pac_nerf.rendering import render as render_field
from neuma_lib.methods.spring_gaus.body import SpringBody
from neuma_lib.methods.spring_gaus.network import Springs
from neuma_lib.methods.spring_gaus.rollout import SpringModel, spring_rollout
from neuma_lib.sim.graphs import GraphCache
from neuma_lib.sim.model import MaterialRegion
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from neuma_lib.splatting import observation, rasterizer
from neuma_lib.splatting.image_loss import mean_squared_error
from neuma_lib.splatting.observation import Observation
from neuma_lib.viewer.live import LiveSimulation
from tests.support.grounding_scene import MODEL, TRUTH, ball, camera, observe
from tests.support.radiance_scenes import CHANNELS, LATTICE, OPACITY, random, scattered, small_scene
from tests.support.random_bodies import random_gaussians, random_particles
from tests.support.sim_scenes import make_law

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")

STEPS, FRAMES = 50, (0, 10, 25, 50)
STRUCTURED = {
    "elasticity": {"name": "hencky", "E": 3e4, "nu": 0.3},
    "plasticity": {"name": "von_mises", "yield_stress": 1e3},
}


def launch(law, device, dtype):
    """Start and gradient of a rollout through contact: positions, and gradients of x0, v0 and the weights."""
    body = ball(height=0.24, dtype=dtype)
    law = copy.deepcopy(law).to(device=device, dtype=dtype)
    trained = [p for p in law.parameters() if p.requires_grad]
    x0 = body.x0.to(device).requires_grad_()
    v0 = torch.tensor([0.3, -2.0, 0.1], dtype=dtype, device=device, requires_grad=True)
    state = State(x0, v0, body.mass.to(device), body.vol0.to(device))
    path = rollout(MODEL, law, state, steps=STEPS, frames=FRAMES, total=True)
    weight = torch.linspace(0.5, 1.5, path.x.numel(), dtype=dtype, device=device).reshape(path.x.shape)
    loss = (weight * path.x.square()).sum() + 1e-3 * path.F_total.square().sum()
    grads = torch.autograd.grad(loss, [x0, v0, *trained])
    return path.x.detach().cpu().double(), [g.cpu().double() for g in grads]


def relative(a, b):
    return float((a - b).norm() / b.norm())


@pytest.mark.parametrize("max_neighbours", [None, 10])
def test_binding_is_the_same(max_neighbours):
    means, covars = random_gaussians(5000, seed=1, size=0.02)
    particles, settings = random_particles(20000, seed=2), BindingConfig(max_neighbours=max_neighbours)
    expected, enlarged, added, volumes = bind_two_pass(means, covars, particles, 0.3, settings)
    binding, *others = bind_two_pass(means.cuda(), covars.cuda(), particles.cuda(), 0.3, settings)
    assert binding.indices.is_cuda and added > 0
    assert torch.equal(binding.indptr.cpu(), expected.indptr)
    assert torch.equal(binding.indices.cpu(), expected.indices)
    assert torch.equal(binding.values.cpu(), expected.values)
    assert torch.equal(others[0].cpu(), enlarged) and others[1] == added
    assert torch.equal(others[2].cpu(), volumes)


def with_network(name, dtype=torch.float64):
    """A law with an untrained adaptor: a neural one, or a structured one in either form."""
    if name == "neural":
        law = make_law("neural", dtype)
    else:
        law = structured_law({**STRUCTURED, "form": name}).to(dtype)
    law.attach_adaptor(rank=4, seed=1)
    return law


@pytest.fixture(scope="module", params=["analytic", "neural", *FORMS])
def law(request):
    if request.param == "analytic":
        return analytic_law(TRUTH, MODEL.dt)
    law = with_network(request.param)
    with torch.no_grad():
        for p in law.parameters():
            if p.requires_grad:
                p.add_(0.01 * torch.randn(p.shape, generator=torch.Generator().manual_seed(0)).to(p))
    return law


def test_rollout_through_contact_agrees_in_float64(law):
    x_cpu, grads_cpu = launch(law, "cpu", torch.float64)
    x_gpu, grads_gpu = launch(law, "cuda", torch.float64)
    assert float((x_cpu - x_gpu).abs().max()) < 1e-9
    for on_gpu, on_cpu in zip(grads_gpu, grads_cpu, strict=True):
        assert relative(on_gpu, on_cpu) < 1e-7


def test_float32_stays_as_near_to_float64_as_the_cpu_does(law):
    truth, _ = launch(law, "cpu", torch.float64)
    x_cpu, _ = launch(law, "cpu", torch.float32)
    x_gpu, _ = launch(law, "cuda", torch.float32)
    gpu, cpu = relative(x_gpu, truth), relative(x_cpu, truth)
    assert gpu < 5 * cpu and cpu < 5 * gpu


@pytest.fixture(scope="module", params=["neural", *FORMS])
def drop(request):
    """A ball in contact: arguments of a rollout on the GPU in float32, and a law with an adaptor."""
    body = ball(height=0.2, dtype=torch.float32).to(torch.float32, "cuda")
    law = with_network(request.param, torch.float32).to("cuda")
    v0 = torch.tensor([0.3, -2.0, 0.1], device="cuda")
    return law, (MODEL, law, body.state(v0))


def gradient(law, arguments, **options):
    """Positions and gradients of the adaptor of a rollout of `STEPS` steps."""
    path = rollout(*arguments, steps=STEPS, frames=FRAMES, skip_free_flight=False, **options)
    trained = [p for p in law.parameters() if p.requires_grad]
    grads = torch.autograd.grad(path.x.square().sum() + path.stretch.square().sum(), trained)
    return path.x.detach(), torch.cat([g.flatten() for g in grads])


@pytest.mark.parametrize("scatter", ["runs", "runs_scalar"])
def test_sums_over_runs_of_particles_equal_single_additions(drop, scatter):
    """Sorted and summed in warps, with and without vector atomics."""
    x, grad = gradient(*drop, scatter="atomic")
    x_runs, grad_runs = gradient(*drop, scatter=scatter)
    assert relative(x_runs, x) < 1e-5
    assert relative(grad_runs, grad) < 1e-3


@pytest.mark.parametrize("options", [{}, {"cache_bytes": 0}, {"memory": 2.0e6}, {"total": True}])
def test_graphs_replay_what_was_launched(drop, options):
    """The first call launches, the second records, later ones replay: also with other weights and a new loss."""
    law, arguments = drop
    x, grad = gradient(law, arguments, **options)
    for _ in range(3):
        x_again, grad_again = gradient(law, arguments, **options)
        assert relative(x_again, x) < 1e-5
        assert relative(grad_again, grad) < 1e-3
    adapted = copy.deepcopy(law)
    with torch.no_grad():
        for p in adapted.parameters():
            if p.requires_grad:
                p.add_(0.02)
    x_other, grad_other = gradient(adapted, (arguments[0], adapted, *arguments[2:]), **options)
    plain = {"scatter": "atomic", "total": options.get("total", False)}
    x_plain, grad_plain = gradient(adapted, (arguments[0], adapted, *arguments[2:]), **plain)
    assert relative(x_other, x_plain) < 1e-5 < relative(x_other, x)
    assert relative(grad_other, grad_plain) < 1e-3


def test_graphs_of_one_body_survive_a_rollout_of_two(drop):
    """Other weights at other places in between: nothing recorded may read the old ones."""
    law, arguments = drop
    count = len(arguments[2].x)
    pair = [MaterialRegion(law, 0, count // 2), MaterialRegion(copy.deepcopy(law), count // 2, count)]
    x, grad = gradient(law, arguments)
    for _ in range(4):
        x_two, _ = gradient(law, (arguments[0], pair, *arguments[2:]))
        x_again, grad_again = gradient(law, arguments)
        assert relative(x_two, x) < 1e-5 and relative(x_again, x) < 1e-5
        assert relative(grad_again, grad) < 1e-3


def test_garbage_does_not_end_the_recording_of_a_graph():
    """An array in a reference cycle, which only the garbage collector releases, would invalidate it."""

    class Owner:
        def __init__(self):
            self.array, self.itself = wp.zeros(1024, device="cuda"), self

    def launches():
        x.add_(1)
        for _ in range(2000):  # more objects than the collector's first threshold
            kept.append([])

    x, kept, cache = torch.zeros(8, device="cuda"), [], GraphCache()
    cache.run("add", launches)
    Owner()
    cache.run("add", launches)
    cache.run("add", launches)
    assert gc.isenabled() and (x == 3).all()


def test_prediction_without_gradient_replays_too(drop):
    law, arguments = drop
    with torch.no_grad():
        paths = [rollout(*arguments, steps=STEPS, frames=FRAMES, skip_free_flight=False).x for _ in range(4)]
    x, _ = gradient(law, arguments)
    assert all(relative(path, x) < 1e-5 for path in paths)


def render(device, dtype):
    body = ball(dtype=dtype).to(dtype, device)
    eye = torch.eye(3, dtype=dtype, device=device).expand(2, len(body.x0), 3, 3)
    x = torch.stack([body.x0, body.x0 + 0.01]).requires_grad_()
    images = body.particle_gs(camera(dtype=dtype).to(device=device))(x, eye)
    (grad,) = torch.autograd.grad(images.square().sum(), x)
    return images.detach().cpu(), grad.cpu()


def test_particle_gs_agrees():
    images_cpu, grad_cpu = render("cpu", torch.float64)
    images_gpu, grad_gpu = render("cuda", torch.float64)
    assert float((images_cpu - images_gpu).abs().max()) < 1e-9
    assert relative(grad_gpu, grad_cpu) < 1e-7
    images_32, _ = render("cuda", torch.float32)
    difference = (images_32.double() - images_cpu).abs()
    assert float(difference.mean()) < 1e-5
    assert float((difference.amax(-1) > 1 / 255).double().mean()) < 1e-3


def falling(dtype=torch.float32, frames=5, out_of_sight=()):
    """A falling ball before two cameras, each frame with its own weight, some frames far away."""
    body = ball(dtype=dtype).to(dtype, "cuda")
    views = camera(size=90, dtype=dtype)
    turned = views.viewmats.clone()
    turned[:, :3, 3] += torch.tensor([0.1, -0.05, 0.2], dtype=dtype)
    views = replace(
        views, viewmats=torch.cat([views.viewmats, turned]), Ks=views.Ks.repeat(2, 1, 1), width=101
    ).to(device="cuda")
    steps = torch.linspace(0, 1, frames).to(body.x0)[:, None, None]
    x = body.x0 + steps * torch.tensor([0.02, -0.1, 0.01]).to(body.x0)
    x[list(out_of_sight)] += 50.0
    F = torch.eye(3).to(body.x0) + steps[..., None] * 0.1 * random(len(body.x0), 3, 3).to(body.x0)
    generator = torch.Generator().manual_seed(4)
    seen = torch.randint(256, (frames, 2, 90, 101, 4), dtype=torch.uint8, generator=generator).cuda()
    return body.particle_gs(views), x.contiguous(), F.contiguous(), seen


@pytest.mark.parametrize("out_of_sight", [(), (1, 4), range(5)], ids=["seen", "partly", "unseen"])
def test_error_taken_while_drawing_is_that_of_the_images(out_of_sight, monkeypatch):
    """Value, and gradients of Gaussians and particles, by way of images and without."""
    renderer, x, F, seen = falling(out_of_sight=out_of_sight)
    weight = torch.linspace(0.3, 2.0, len(x), device="cuda")
    results = []
    for drawn in (False, True):
        states = x.clone().requires_grad_(), F.clone().requires_grad_()
        deformed = renderer.deformed(*states)
        if drawn:
            with monkeypatch.context() as patch:
                patch.setattr(rasterizer, "rasterize", lambda *_, **__: pytest.fail("images were made"))
                losses = renderer.splatted_error(*deformed, seen)
        else:
            losses = mean_squared_error(renderer.splatted(*deformed), seen)
        results.append([losses.detach(), *torch.autograd.grad(losses, (*deformed, *states), weight)])
    for index, (by_images, at_once) in enumerate(zip(*results, strict=True)):
        assert float((at_once - by_images).norm()) <= 1e-5 * float(by_images.norm()), index
    empty = torch.zeros(len(x), dtype=torch.bool)
    empty[list(out_of_sight)] = True
    for grad in results[1][1:]:
        assert torch.equal(grad.flatten(1).norm(dim=1).cpu() == 0, empty), "exactly the frames out of sight"


def test_equal_renders_have_equal_errors():
    renderer, x, F, seen = falling()
    with torch.no_grad():
        first, *others = (renderer.error(x, F, seen) for _ in range(4))
        assert all(torch.equal(first, other) for other in others)
        one_by_one = [renderer.error(x[t : t + 1], F[t : t + 1], seen[t : t + 1]) for t in range(len(x))]
    assert relative(torch.cat(one_by_one), first) < 1e-6, "a frame's loss does not depend on its batch"


def test_error_of_a_large_image_of_one_colour():
    """Nothing is drawn, so the sum over more than a million pixels is known."""
    renderer, x, F, _ = falling(frames=1, out_of_sight=(0,))
    size = 1203
    views = replace(renderer.cameras, width=size, height=size)
    large = ParticleGS(renderer.gaussians, renderer.binding, renderer.x0, views, background=(0.5,) * 3)
    seen = torch.full((1, 2, size, size, 4), 255, dtype=torch.uint8, device="cuda")
    seen[..., :3] = 102
    assert float(large.error(x, F, seen)) == pytest.approx(0.01, rel=1e-6)


def seen_particles(device, dtype):
    """Particles to nodes to rays: colours and transmittances, and gradients of positions, features and network."""
    _, network, *rays = small_scene(density=150.0)
    network = network.to(device, dtype)
    x, features = scattered(300), 30 * random(300, CHANNELS) - 5
    x, features = (value.to(device, dtype).requires_grad_() for value in (x, features))
    rays = (part.to(device, dtype) for part in rays)
    colours, passed = render_field(LATTICE, from_particles(LATTICE, x, features), OPACITY, network, *rays)
    weight = torch.linspace(0.5, 1.5, colours.numel(), dtype=dtype, device=device).view(colours.shape)
    loss = (weight * colours).sum() + passed.square().sum()
    grads = torch.autograd.grad(loss, [x, features, *network.parameters()])
    return colours.detach().cpu(), [grad.cpu() for grad in grads]


def test_volume_rendering_of_particles_agrees():
    colours_cpu, grads_cpu = seen_particles("cpu", torch.float64)
    colours_gpu, grads_gpu = seen_particles("cuda", torch.float64)
    assert float((colours_cpu - colours_gpu).abs().max()) < 1e-9
    for ours, expected in zip(grads_gpu, grads_cpu, strict=True):
        assert relative(ours, expected) < 1e-7
    colours_32, _ = seen_particles("cuda", torch.float32)
    assert float((colours_32.double() - colours_cpu).abs().mean()) < 1e-5


def train(device, settings, checkpoint=None):
    """Fit a stiff random law to the video of a soft ball in contact."""
    body = ball(height=0.2, dtype=torch.float32).to(torch.float32, device)
    law = neural_law(seed=5)
    with torch.no_grad():
        law.elasticity.base[2].mul_(3e4 / max(law.longitudinal_modulus(), 1.0))
    law = law.to(device)
    law.attach_adaptor(rank=4, seed=1)
    v0 = torch.tensor([0.0, -1.5, 0.0], device=device)
    loss = PixelLoss(body, observe(body, v0, (0, 20, 40)), frames_per_batch=2)
    return train_material(
        MODEL, law, body.state(v0), loss, settings, checkpoint=checkpoint, log=lambda _: None
    )


@pytest.mark.parametrize("precision", ["single", "half"])
def test_training_runs_on_the_gpu(precision):
    result = train("cuda", TrainingConfig(iterations=5, adjoint_precision=precision))
    assert result.best_loss < result.history.loss[0]
    assert len(result.history.seconds) == 5


class Killed(Checkpoint):
    """Writes its first state, and then the power fails."""

    def save(self, state):
        super().save(state)
        raise KeyboardInterrupt


@pytest.mark.parametrize("device", ["cuda", "cpu"])
def test_a_training_killed_on_the_gpu_resumes_on_either_device(tmp_path, device):
    settings = TrainingConfig(iterations=6, checkpoint_every=3)
    whole = train("cuda", settings)
    with pytest.raises(KeyboardInterrupt):
        train("cuda", settings, Killed(tmp_path / "state.pt", {}))
    resumed = train(device, settings, Checkpoint(tmp_path / "state.pt", {}))
    assert resumed.history.loss == pytest.approx(whole.history.loss, rel=0.02)
    for name, value in whole.law.adaptor_state().items():
        again = resumed.law.adaptor_state()[name]
        assert again.device.type == device
        assert relative(again.cpu(), value.cpu()) < 0.05, name


def test_velocity_from_bytes_agrees():
    """Frames before contact on both devices, from decoded images."""
    estimates = {}
    for device in ("cpu", "cuda"):
        body = ball().to(torch.float64, device)
        seen = observe(body, [0.5, -1.2, 0.4], (0, 4, 8, 12, 16))
        opaque = torch.ones_like(seen.images[..., :1])
        pixels = (255 * torch.cat([seen.images, opaque], -1).clamp(0, 1)).round().to(torch.uint8)
        law = analytic_law(TRUTH, MODEL.dt).to(device)
        estimates[device] = estimate_velocity(
            MODEL, law, body, replace(seen, images=pixels), VelocityConfig()
        )
    # single precision on the GPU, double on the CPU: far below what the images leave open
    gpu, cpu = estimates["cuda"], estimates["cpu"]
    assert (abs(gpu.v0 - cpu.v0) < 0.25 * cpu.std).all()
    assert (abs(gpu.std - cpu.std) < 0.1 * cpu.std).all()


def test_a_video_that_does_not_fit_stays_off_the_device(monkeypatch):
    """Frames then go there a part at a time; colours and losses are the same."""
    cameras = camera(dtype=torch.float32)
    images = torch.randint(256, (3, 1, cameras.height, cameras.width, 4), dtype=torch.uint8)
    video = Observation((0, 1, 2), images, cameras)
    kept = video.to(torch.float32, "cuda")
    monkeypatch.setattr(observation, "_DEVICE_SHARE", 0.0)
    streamed = video.to(torch.float32, "cuda")
    assert kept.images.is_cuda and not streamed.images.is_cuda
    assert torch.equal(kept.colours(slice(1, 3)), streamed.colours(slice(1, 3)))
    assert streamed.stored([2]).is_cuda


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_springs_agree(dtype):
    """Motion of the particles that follow them, and gradients, of a fall onto the ground."""
    results = []
    for device in ("cpu", "cuda"):
        body = ball(height=0.24, dtype=dtype).to(dtype, device)
        anchored = SpringBody.of(body.x0, 60, 12, 4, 0.5, 12)
        springs = Springs.of_modulus(anchored.network, 1e5, 1000.0, 0.1)
        state = body.state((0.3, -2.0, 0.1))
        x, v, _ = spring_rollout(SpringModel.of(MODEL), springs, *anchored.start(state), FRAMES)
        path = anchored.path(FRAMES, x, v)
        grads = torch.autograd.grad(path.x.square().sum() + path.F.square().sum(), list(springs.parameters()))
        results.append([t.detach().cpu().double() for t in (path.x, path.F, *grads)])
    bound = {torch.float32: 1e-3, torch.float64: 1e-9}[dtype]
    for cpu, cuda in zip(*results, strict=True):
        assert relative(cuda, cpu) < bound


def test_the_live_mode_simulates_on_the_gpu_what_it_does_on_the_cpu():
    results = []
    for device in ("cpu", "cuda"):
        body, law = ball(height=0.2, dtype=torch.float32), with_network("neural", torch.float32)
        start = body.state(torch.tensor([0.3, -2.0, 0.1])).to(device)
        live = LiveSimulation({"grid": MODEL.grid}, start, law.requires_grad_(False).to(device), MODEL.dt)
        live.open()
        try:
            while live.wait(live.snapshot.number + 1).time < 0.1:
                assert live.snapshot.trouble is None
            live.add(body.state(torch.zeros(3)).to(device), law.to(device), MODEL.dt)
            live.drop(0.3)
            live.set_weight(0.5)
            live.launch((1.0, 0.0, 0.0))
            live.hold((0.6, 0.3, 0.5))
            last = live.do()
            assert last.counts == (len(body.x0),) * 2 and last.notice is last.trouble is None
            live.hold(None)
            live.reset()
            live.run(False)
            results.append(live.do().x)
        finally:
            live.close()
        assert last.x.device == last.total.device == torch.device("cpu")
    assert torch.equal(*results)
