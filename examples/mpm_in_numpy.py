"""A learned law in another material point method: python examples/mpm_in_numpy.py law.safetensors."""

import sys

import isotropic_in_numpy
import law_in_numpy
import numpy as np

OFFSETS = np.stack(np.meshgrid(*[range(3)] * 3, indexing="ij"), axis=-1).reshape(27, 3)


def step(law, x, v, C, F, mass, volume, dt, grid, gravity):
    """One step of MLS-MPM on the unit cube, its floor at the third node from below.

    x, v (N, 3) [m, m/s], C, F (N, 3, 3), mass [kg] and initial volume [m^3] of a particle, grid cells along the cube.
    """
    elasticity, plasticity, _ = law
    base = np.floor(x * grid - 0.5).astype(int)
    f = x * grid - base
    weights = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2])
    w = np.prod([weights[OFFSETS[:, axis], :, axis] for axis in range(3)], axis=0)  # (27, N)
    nodes = np.ravel_multi_index(np.moveaxis(base + OFFSETS[:, None], -1, 0), [grid] * 3)
    away = (OFFSETS[:, None] - f) / grid
    # The law gives Kirchhoff stresses, which go with the initial volume.
    affine = mass * C - dt * volume * 4 * grid**2 * elasticity(F)
    p = w[..., None] * (mass * v + np.einsum("nij,knj->kni", affine, away))
    m_grid = np.bincount(nodes.ravel(), (w * mass).ravel(), grid**3)
    v_grid = np.stack([np.bincount(nodes.ravel(), p[..., i].ravel(), grid**3) for i in range(3)], axis=1)
    v_grid = v_grid / np.where(m_grid > 0, m_grid, 1)[:, None] + dt * np.asarray(gravity)
    v_grid.reshape(grid, grid, grid, 3)[:, :3] = 0  # the floor
    seen = w[..., None] * v_grid[nodes]
    v, C = seen.sum(0), 4 * grid**2 * np.einsum("kni,knj->nij", seen, away)
    return x + dt * v, v, C, plasticity(F + dt * C @ F)


def main(path):
    kind = law_in_numpy.read(path)[1]["export"]["kind"]
    law = (law_in_numpy if kind == "networks" else isotropic_in_numpy).load(path)
    about, grid, side = law[2], 24, 6
    dt = about["dt"]  # networks know the step that they were learned at, and no other
    ticks = 0.5 + 0.2 * ((np.arange(side) + 0.5) / side - 0.5)
    x = np.stack(np.meshgrid(ticks, ticks - 0.2, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    volume = 0.2**3 / len(x)
    density = about["density"] if isinstance(about["density"], float) else 1000.0
    v, C, F = np.zeros_like(x), np.zeros((len(x), 3, 3)), np.tile(np.eye(3), (len(x), 1, 1))
    for n in range(round(0.3 / dt) + 1):
        if n % round(0.04 / dt) == 0:
            print(f"{n * dt:.2f} s: lowest {x[:, 1].min():.3f} m, highest {x[:, 1].max():.3f} m")
        x, v, C, F = step(law, x, v, C, F, density * volume, volume, dt, grid, (0, -9.8, 0))


if __name__ == "__main__":
    main(sys.argv[1])
