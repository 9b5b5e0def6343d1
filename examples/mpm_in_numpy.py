"""A learned law in another material point method: python examples/mpm_in_numpy.py law.safetensors."""

import sys

import isotropic_in_numpy as laws
import numpy as np

OFFSETS = np.indices((3, 3, 3)).reshape(3, 27).T[:, None]  # of the 27 nodes around a particle, (27, 1, 3)


def step(elasticity, plasticity, x, v, C, F, mass, volume, dt, grid, gravity):
    """One step of MLS-MPM on the unit cube, its floor at the third node from below.

    x, v (N, 3) [m, m/s], C, F (N, 3, 3), mass [kg] and initial volume [m^3] of a particle, grid cells along the cube.
    """
    base, f = np.divmod(x * grid - 0.5, 1)
    weights = np.stack([0.5 * (1 - f) ** 2, 0.75 - (f - 0.5) ** 2, 0.5 * f**2])
    w = np.prod([weights[OFFSETS[:, 0, axis], :, axis] for axis in range(3)], axis=0)  # (27, N)
    nodes = np.ravel_multi_index(np.moveaxis(base.astype(int) + OFFSETS, -1, 0), [grid] * 3)
    away = (OFFSETS - f - 0.5) / grid
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


if __name__ == "__main__":
    elasticity, plasticity, about = laws.load(sys.argv[1])
    grid, dt = 24, about["dt"]  # networks know the step that they were learned at, and no other
    x = (0.4, 0.2, 0.4) + 0.2 * (np.indices((6, 6, 6)).reshape(3, -1).T + 0.5) / 6
    volume, density = 0.2**3 / len(x), about["density"]
    mass = volume * (density if isinstance(density, float) else 1000.0)
    v, C, F = np.zeros_like(x), np.zeros((len(x), 3, 3)), np.tile(np.eye(3), (len(x), 1, 1))
    for n in range(round(0.3 / dt) + 1):
        if n % round(0.04 / dt) == 0:
            print(f"{n * dt:.2f} s: lowest {x[:, 1].min():.3f} m, highest {x[:, 1].max():.3f} m")
        x, v, C, F = step(elasticity, plasticity, x, v, C, F, mass, volume, dt, grid, (0, -9.8, 0))
