"""Division of Gaussians into bodies by labelled images."""

import numpy as np
import torch
import trimesh

from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.labels import bodies_of, without_others
from neuma_lib.splatting.rasterizer import rasterize
from neuma_lib.splatting.spherical_harmonics import SH_C0
from neuma_lib.splatting.viewpoints import static_views
from tests.support.errors import refused


def touching(count=4):
    """Balls in a row that touch, each of 300 Gaussians on its surface and 20 inside, with their bodies."""
    rng, points = np.random.default_rng(0), []
    for k in range(count):
        sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
        surface, _ = trimesh.sample.sample_surface(sphere, 300, seed=k)
        inner = 0.03 * rng.standard_normal((20, 3)).clip(-1, 1)
        points.append(np.concatenate([surface, inner]) + np.array([0.2 + 0.2 * k, 0.5, 0.5]))
    means = torch.from_numpy(np.concatenate(points)).float()
    N = len(means)
    quats = torch.tensor([1.0, 0, 0, 0]).expand(N, 4)
    gaussians = Gaussians(
        means,
        quats,
        torch.full((N, 3), 0.012),
        torch.full((N,), 0.95),
        torch.zeros(N, 1, 3),
        torch.zeros(N, 0, 3),
    )
    return gaussians, torch.arange(count).repeat_interleave(320)


def labelled(gaussians, bodies, count):
    """Cameras around the Gaussians, and the body with the largest share in each pixel, by renders of one in white."""
    views = static_views(gaussians.means.numpy(), 6, 96, 96)
    flip = np.diag([1.0, -1.0, -1.0, 1.0])  # from the axes of OpenGL to those of OpenCV
    viewmats = torch.from_numpy(np.linalg.inv(views.c2w @ flip)).float()
    K = (
        torch.tensor([[views.focal, 0, 48], [0, views.focal, 48], [0, 0, 1]])
        .float()
        .expand(6, 3, 3)
        .contiguous()
    )
    cameras = Cameras(viewmats, K, 96, 96)
    shares = []
    for k in range(count):
        sh = torch.where((bodies == k)[:, None, None], 1.0, -1.0) * (0.5 / SH_C0) * torch.ones(1, 1, 3)
        pictures, alphas = rasterize(
            gaussians.means[None], gaussians.covars()[None], gaussians.opacities, sh, viewmats, K, 96, 96,
            background=(0.0, 0.0, 0.0), eps2d=0.0,
        )  # fmt: skip
        shares.append(pictures[0, ..., 0])
    share = torch.stack(shares)
    return cameras, torch.where(alphas[0] > 0.5, 1 + share.argmax(dim=0), 0)


def test_each_gaussian_belongs_to_one_body():
    """Balls that touch, of which one hides another in some views; those inside follow the nearest visible one."""
    gaussians, bodies = touching()
    cameras, labels = labelled(gaussians, bodies, 4)
    assigned = bodies_of(gaussians, cameras, labels, 4)
    assert assigned.shape == bodies.shape and set(assigned.tolist()) == {0, 1, 2, 3}
    wrong = assigned != bodies
    assert wrong.float().mean() < 0.01
    contact = (gaussians.means[:, :1] - torch.tensor([0.3, 0.5, 0.7])).abs().amin(dim=1)
    assert (contact[wrong] < 0.02).all()


def test_labels_that_do_not_match_are_refused():
    gaussians, bodies = touching(2)
    cameras, labels = labelled(gaussians, bodies, 2)
    with refused("labels", problem="5 images"):
        bodies_of(gaussians, cameras[[0, 1, 2, 3, 4]], labels, 2)
    with refused("labels", problem="labels up to 2"):
        bodies_of(gaussians, cameras, labels, 1)
    with refused("labels", problem="body 2"):
        bodies_of(gaussians, cameras, labels.clamp(max=1), 2)


def test_a_hidden_part_is_that_of_the_whole_body():
    """Images of a ball behind others, completed, are those of the ball alone; visible pixels are not changed."""
    gaussians, bodies = touching()
    cameras, labels = labelled(gaussians, bodies, 4)
    own = gaussians[bodies == 1]
    pictures, alphas = rasterize(
        own.means[None], own.covars()[None], own.opacities, own.sh(), cameras.viewmats, cameras.Ks, 96, 96,
        background=(0.0, 0.0, 0.0), eps2d=0.0,
    )  # fmt: skip
    alone = torch.cat([pictures[0] / alphas[0, ..., None].clamp_min(1e-6), alphas[0, ..., None]], dim=-1)
    hidden = (labels != 0) & (labels != 2)
    images = torch.where(hidden[..., None], 0.0, alone)
    assert (alone[..., 3][hidden] > 0.5).sum() > 100
    completed = without_others(own, cameras, images, hidden)
    torch.testing.assert_close(completed, alone.clamp(0, 1))
    assert (without_others(own, cameras, images, torch.zeros_like(hidden)) == images).all()
