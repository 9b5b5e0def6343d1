"""MPM with the choices of other engines, slow and in NumPy: which of them makes their motion differ from ours.

    python -m benchmarks.engine_schemes           # from our scheme to that of newton, one choice at a time
    python -m benchmarks.engine_schemes sand      # sand that remembers its expansion, as in Genesis

With the defaults it is our scheme: quadratic B-splines, velocity gradients from the affine part of the velocity
(C = 4 / dx^2 sum w v d^T), explicit steps. newton 1.8.0 has trilinear functions, gradients of these, one strain rate
and stress a cell, and implicit steps. The start is that of `benchmarks.engine_agreement free`, newton with a cube of
0.1 m.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

import neuma_lib as nm
from benchmarks.engine_agreement import cube, millimetres, ours, played, spec_of
from neuma_lib.export.scenes import EngineScene, export_scene
from neuma_lib.mechanics.catalogue import lame

Return = Callable[[np.ndarray], np.ndarray]  # trial deformation gradients (N, 3, 3) -> elastic ones
ITERATIONS, TOLERANCE = 500, 1e-7
"""Of the fixed point of an implicit step: their largest number, and largest change of a velocity [m/s]."""


def simulate(
    scene: EngineScene,
    law: nm.Law,
    *,
    returned: Return | None = None,
    trilinear: bool = False,
    gradient: bool = False,
    a_cell: bool = False,
    implicit: bool = False,
) -> np.ndarray:
    """Final positions (N, 3) [m].

    Args:
        returned: a return map in place of that of the law.
        trilinear: functions in place of quadratic B-splines.
        gradient: velocity gradients and forces with the gradients of these functions.
        a_cell: strain rates and stresses are means over the particles in a cell.
        implicit: stresses are those at the end of a step.
    """
    returned = returned or (lambda F: law.plasticity(torch.from_numpy(F)).numpy())
    h, n, x, v = 1 / scene.grid, len(scene.x), scene.x.copy(), scene.v.copy()
    C, F = np.zeros((n, 3, 3)), np.tile(np.eye(3), (n, 1, 1))
    strides, k = np.array([1 << 20, 1 << 10, 1]), 2 if trilinear else 3
    offsets = np.indices((k,) * 3).reshape(3, -1).T
    for _ in range(scene.steps):
        base = np.floor(x / h - (0.0 if trilinear else 0.5)).astype(int)
        f = x / h - base
        if trilinear:
            w, slope = np.stack([1 - f, f], 1), np.stack([-np.ones_like(f), np.ones_like(f)], 1) / h
        else:
            w = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2], 1)
            slope = np.stack([f - 1.5, 2 - 2 * f, f - 0.5], 1) / h
        own, slopes = w[:, offsets, range(3)], slope[:, offsets, range(3)]  # (N, nodes, 3)
        W, d = own.prod(axis=2), (offsets - f[:, None]) * h
        if gradient:
            turned = np.roll(own, -1, 2) * np.roll(own, -2, 2)
            G = slopes * turned
        else:
            G = 4 / h**2 * W[:, :, None] * d
        nodes, index = np.unique((base[:, None] + offsets) @ strides, return_inverse=True)
        index = index.reshape(W.shape)
        cells = np.unique(np.floor(x / h).astype(int) @ strides, return_inverse=True)[1]

        def total(values: np.ndarray, index: np.ndarray, count: int) -> np.ndarray:
            rows = values.reshape(index.size, -1).T
            return np.stack([np.bincount(index.ravel(), row, count) for row in rows], axis=1)

        def mean(values: np.ndarray, cells=cells) -> np.ndarray:
            if not a_cell:
                return values
            count = np.bincount(cells)
            return (total(values, cells, len(count)) / count[:, None])[cells].reshape(values.shape)

        M = total(W * scene.mass[:, None], index, len(nodes))
        affine = v[:, None] + np.einsum("nij,nkj->nki", C, d)
        start = total((W * scene.mass[:, None])[..., None] * affine, index, len(nodes)) / M
        start += scene.dt * np.array(scene.gravity)

        def stretched(u: np.ndarray, F=F, G=G, index=index) -> np.ndarray:
            L = np.einsum("nki,nkj->nij", u[index], G)
            skew = 0.5 * (L - L.transpose(0, 2, 1))
            return returned(F + scene.dt * (mean(L - skew) + skew) @ F)

        def moved(F: np.ndarray, start=start, M=M, G=G, index=index) -> np.ndarray:
            stress = mean(law.elasticity(torch.from_numpy(F)).numpy())
            force = np.einsum("n,nij,nkj->nki", scene.vol0, stress, G)
            return start - scene.dt * total(force, index, len(M)) / M

        u = moved(F)
        for _ in range(ITERATIONS if implicit else 0):
            new = moved(stretched(u))
            if np.abs(new - u).max() < TOLERANCE:
                break
            u = 0.5 * (u + new)
        v, C, F = np.einsum("nk,nki->ni", W, u[index]), np.einsum("nki,nkj->nij", u[index], G), stretched(u)
        x += scene.dt * v
    return x


class RememberedExpansion:
    """Return map of Genesis' sand: a particle resists once it is compressed by the volume that it has expanded by.

    A sum of logarithmic strains is kept as in `MPM.Sand` of genesis-world 1.4.5 (after Klar et al. 2016).
    """

    def __init__(self, E: float, nu: float, friction_angle: float):
        sine, (mu, lam) = np.sin(np.radians(friction_angle)), lame(E, nu)
        self.slope = (3 * lam + 2 * mu) / (2 * mu) * np.sqrt(2 / 3) * 2 * sine / (3 - sine)
        self.expansion: Any = 0.0

    def __call__(self, F: np.ndarray) -> np.ndarray:
        U, S, Vh = np.linalg.svd(F)
        strain = np.log(S)
        total = strain.sum(axis=1, keepdims=True) + self.expansion
        rest = strain - total / 3
        norm = np.linalg.norm(rest, axis=1, keepdims=True)
        flow = np.maximum(0, norm + self.slope * total) / norm
        self.expansion = np.maximum(0, total)
        return U @ (np.exp(np.where(total < 0, strain - flow * rest, 0))[:, :, None] * Vh)


def to_newton(dt: float) -> None:
    """Print how far each choice of newton moves the particles from ours, and newton itself from all together."""
    scene, spec = cube(dt, 8), spec_of("hencky")
    law, own, options = nm.Law.from_spec(spec, dt), ours(scene, spec)[-1], {}
    print(f"hencky, step {1e3 * dt:g} ms: ours moves {millimetres(own - scene.x)} mm")
    for name in ("", "gradient", "trilinear", "a_cell", "implicit"):
        options |= {name: True} if name else {}
        last = simulate(scene, law, **options)
        print(f"  {', '.join(options) or 'our choices'}: from ours {millimetres(last - own)} mm", flush=True)
    with TemporaryDirectory() as folder:
        export_scene(folder, "newton", scene, spec, {})
        theirs = played(Path(folder))["x"][-1]
    rest = millimetres(theirs - last)
    print(f"  newton: from ours {millimetres(theirs - own)} mm, from its choices here {rest} mm", flush=True)


def sand(dt: float = 5e-4) -> None:
    """Print how far sand that remembers its expansion moves from ours."""
    scene, spec = cube(dt), spec_of("hencky", "drucker_prager")
    law, own = nm.Law.from_spec(spec, dt), ours(scene, spec)[-1]
    angle = spec["plasticity"]["friction_angle"]
    memory = RememberedExpansion(spec["elasticity"]["E"], spec["elasticity"]["nu"], angle)
    for name, returned in (("ours", None), ("remembered expansion", memory)):
        x = simulate(scene, law, returned=returned)
        print(f"sand, {name}: from ours {millimetres(x - own)} mm", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    if sys.argv[1:] == ["sand"]:
        sand()
    else:
        for dt in (1e-3, 5e-4):
            to_newton(dt)
