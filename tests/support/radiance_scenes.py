"""A small lattice of random densities and features, particles in it and rays through it; what a gradient keeps."""

from contextlib import contextmanager

import torch

from neuma_lib.methods.pac_nerf.lattice import Lattice
from neuma_lib.methods.pac_nerf.rendering import ColourNetwork, Opacity, camera_rays
from neuma_lib.splatting.cameras import Cameras, look_at

LATTICE = Lattice((0.1, -0.2, 0.3), 0.05, (7, 6, 8))
OPACITY = Opacity(1e-2, 0.1)
CHANNELS = 5


def random(*shape, seed=0, dtype=torch.float64):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def scattered(count, seed=0):
    """Points in the lattice, none within a thousandth of a voxel of a cell's side: there weights have kinks."""
    cells = (torch.tensor(LATTICE.nodes) - 1) * random(count, 3, seed=seed)
    inside = cells.floor() + 1e-3 + (cells - cells.floor()) * (1 - 2e-3)
    return torch.tensor(LATTICE.origin, dtype=torch.float64) + LATTICE.voxel * inside


def small_scene(density=8.0):
    """Values at the nodes, a network, and rays from two cameras, some of which miss the lattice."""
    values = 8.0 * (random(*LATTICE.nodes, CHANNELS, seed=1) - 0.3)
    values[..., 0] *= density / 8.0
    torch.manual_seed(0)
    network = ColourNetwork(CHANNELS - 1, width=16).double()
    middle = (torch.tensor(LATTICE.origin) + torch.tensor(LATTICE.far)).double() / 2
    eyes = middle + torch.tensor([[0.5, 0.3, 0.6], [-0.6, 0.2, 0.1]], dtype=torch.float64)
    up = torch.tensor([0.0, 1.0, 0.1], dtype=torch.float64)
    K = torch.tensor([[9.0, 0, 4.1], [0, 9.0, 3.2], [0, 0, 1]], dtype=torch.float64)
    cameras = Cameras(look_at(eyes, middle, up), K.expand(2, 3, 3).contiguous(), 8, 7)
    rays = [torch.cat(parts) for parts in zip(camera_rays(cameras, 0), camera_rays(cameras, 1), strict=True)]
    return values, network, *rays


@contextmanager
def kept_for_gradient():
    """Yields a list of one number: most bytes that autograd has kept at a time, tensors that share memory once."""
    most, users = [0], {}

    class Kept:
        def __init__(self, tensor):
            self.tensor, storage = tensor, tensor.untyped_storage()
            self.memory = storage.data_ptr(), storage.nbytes()
            users[self.memory] = users.get(self.memory, 0) + 1
            most[0] = max(most[0], sum(size for _, size in users))

        def __del__(self):
            users[self.memory] -= 1
            if not users[self.memory]:
                del users[self.memory]

    with torch.autograd.graph.saved_tensors_hooks(Kept, lambda kept: kept.tensor):
        yield most
