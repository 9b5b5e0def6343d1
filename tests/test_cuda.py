"""The CPU and a CUDA GPU run the same functions and agree. Skipped, saying so, where there is no GPU."""

import copy

import pytest
import torch
from grounding_scene import MODEL, TRUTH, ball, camera
from sim_scenes import make_law

from neuma_lib.fitting.material import MaterialSettings, PixelLoss, train_material
from neuma_lib.fitting.observation import Observation
from neuma_lib.materials import analytic_law, neural_law
from neuma_lib.sim import rollout

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")

STEPS, FRAMES = 50, (0, 10, 25, 50)


def throw(law, device, dtype):
    """Start and gradient of a rollout through contact: positions, and gradients of x0, v0 and the weights."""
    body = ball(height=0.24, dtype=dtype)
    law = copy.deepcopy(law).to(device=device, dtype=dtype)
    trained = [p for p in law.parameters() if p.requires_grad]
    x0 = body.x0.to(device).requires_grad_()
    v0 = torch.tensor([0.3, -2.0, 0.1], dtype=dtype, device=device, requires_grad=True)
    path = rollout(MODEL, law, x0, v0, body.mass.to(device), body.vol0.to(device), steps=STEPS, frames=FRAMES)
    weight = torch.linspace(0.5, 1.5, path.x.numel(), dtype=dtype, device=device).reshape(path.x.shape)
    grads = torch.autograd.grad((weight * path.x.square()).sum(), [x0, v0, *trained])
    return path.x.detach().cpu().double(), [g.cpu().double() for g in grads]


def relative(a, b):
    return float((a - b).norm() / b.norm())


@pytest.fixture(scope="module", params=["analytic", "neural"])
def law(request):
    if request.param == "analytic":
        return analytic_law(TRUTH, MODEL.dt)
    law = make_law("neural")
    law.attach_adaptor(rank=4, seed=1)
    with torch.no_grad():
        for p in law.parameters():
            if p.requires_grad:
                p.add_(0.01 * torch.randn(p.shape, generator=torch.Generator().manual_seed(0)).to(p))
    return law


def test_rollout_through_contact_agrees_in_float64(law):
    x_cpu, grads_cpu = throw(law, "cpu", torch.float64)
    x_gpu, grads_gpu = throw(law, "cuda", torch.float64)
    assert float((x_cpu - x_gpu).abs().max()) < 1e-9
    for on_gpu, on_cpu in zip(grads_gpu, grads_cpu, strict=True):
        assert relative(on_gpu, on_cpu) < 1e-7


def test_float32_stays_as_near_to_float64_as_the_cpu_does(law):
    truth, _ = throw(law, "cpu", torch.float64)
    x_cpu, _ = throw(law, "cpu", torch.float32)
    x_gpu, _ = throw(law, "cuda", torch.float32)
    assert relative(x_gpu, truth) < 5 * relative(x_cpu, truth)


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


def test_training_runs_on_the_gpu():
    body = ball(dtype=torch.float32).to(torch.float32, "cuda")
    law = neural_law(seed=5)
    with torch.no_grad():
        law.elasticity.base[2].mul_(3e4 / max(law.longitudinal_modulus(), 1.0))
    law = law.to("cuda")
    law.attach_adaptor(rank=4, seed=1)
    cameras = camera(dtype=torch.float32).to(device="cuda")
    v0 = torch.tensor([0.0, -1.5, 0.0], device="cuda")
    frames = (0, 20, 40)
    with torch.no_grad():
        path = rollout(
            MODEL,
            analytic_law(TRUTH, MODEL.dt).to("cuda"),
            body.x0,
            v0,
            body.mass,
            body.vol0,
            steps=40,
            frames=frames,
        )
        video = Observation(frames, body.particle_gs(cameras)(path.x, path.F), cameras)
    result = train_material(
        MODEL, law, body, v0, PixelLoss(body, video), MaterialSettings(iterations=5), log=lambda _: None
    )
    assert result.best_loss < result.history.loss[0]
