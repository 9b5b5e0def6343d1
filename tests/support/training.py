"""What several tests share of material training."""

import copy

import torch

from neuma_lib.mechanics.neural import neural_law

FRAMES = (0, 20, 40, 60)
V0 = torch.tensor([0.0, -1.5, 0.0], dtype=torch.float64)


def stiff_random_law(dtype=torch.float64, rank=4):
    """A random network scaled so that its small-strain stiffness is near 3e4 Pa, with a fresh adaptor."""
    torch.manual_seed(2)
    law = neural_law(seed=5).to(dtype)
    with torch.no_grad():
        modulus = max(law.longitudinal_modulus(), 1.0)
        law.elasticity.base[2].mul_(3e4 / modulus)
    law.attach_adaptor(rank=rank, seed=1)
    return law


class MemoryCheckpoint:
    """Keeps every state that it is given; interrupts after ``fail_after`` of them."""

    def __init__(self, fail_after=None):
        self.states, self.fail_after = [], fail_after

    def load(self):
        return copy.deepcopy(self.states[-1]) if self.states else None

    def save(self, state):
        self.states.append(copy.deepcopy(state))
        if len(self.states) == self.fail_after:
            raise KeyboardInterrupt
