"""What several tests share of structured law."""

import torch

from neuma_lib.mechanics.structured import FORMS, structured_law
from tests.support.deformations import EYE, deformations, rotations

E, NU, DT = 1e5, 0.3, 1e-3
BASES = ("hencky", "neo_hookean", "fixed_corotated")
RETURNS = {
    "von_mises": {"name": "von_mises", "yield_stress": 5e3},
    "drucker_prager": {"name": "drucker_prager", "friction_angle": 25.0},
    "cohesive": {"name": "drucker_prager", "friction_angle": 25.0, "cohesion": 0.01},
    "viscous_flow": {"name": "viscous_flow", "viscosity": 10.0},
    "bingham": {"name": "viscous_flow", "viscosity": 10.0, "yield_stress": 1e3},
}
ELASTIC = [(base, form) for base in BASES for form in FORMS]


def specification(base="hencky", plastic=None) -> dict:
    spec = {"elasticity": {"name": base, "E": E, "nu": NU}}
    return spec if plastic is None else spec | {"plasticity": RETURNS[plastic]}


def elasticity(base, form):
    return structured_law({**specification(base), "form": form}).elasticity


def plasticity(name):
    return structured_law(specification(plastic=name), dt=DT).plasticity


def random_weights(part, seed=0, dtype=torch.float64):
    """Weights with which every output varies over the deformations used here."""
    generator = torch.Generator().manual_seed(seed)
    return tuple(
        (torch.randn(w.shape, generator=generator, dtype=torch.float64) * 3 / w.shape[1] ** 0.5).to(dtype)
        for w in part.base
    )


def near_states():
    """Deformations, rest, equal stretches, and stretches that are nearly equal."""
    stretches = [[1.2, 1.2, 0.8], [1.1, 0.9, 0.9]]
    stretches += [[1.1 + gap, 1.1, 0.9] for gap in (1e-9, 1e-6, 1e-3)] + [[1 + 1e-8, 1, 1 - 1e-8]]
    special = torch.diag_embed(torch.tensor(stretches, dtype=torch.float64))
    Q = rotations(len(special), 40)
    return torch.cat([deformations(60), EYE[None], Q @ special @ rotations(len(special), 41)])
