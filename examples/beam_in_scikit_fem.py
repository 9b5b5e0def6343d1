"""A law in finite elements: a patch test, and a beam that sags, next to its MPM motion.

pip install scikit-fem; python examples/beam_in_scikit_fem.py [law.safetensors]
"""

import sys

import numpy as np
import skfem
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

import neuma_lib as nm
from neuma_lib.sim.clamps import Clamp

LENGTH, HEIGHT, RHO, G, STEP, STEPS, CELLS = 0.3, 0.15, 1000.0, 9.8, 5e-3, 30, 80
JELLY = {"elasticity": {"name": "neo_hookean", "E": 3e5, "nu": 0.3}}
law = nm.Law.load(sys.argv[1]) if len(sys.argv) > 1 else nm.Law.from_spec(JELLY)
eye = torch.eye(3, dtype=torch.float64)

mesh = skfem.MeshTet.init_tensor(
    *(np.linspace(0, end, n) for end, n in ((LENGTH, 7), (HEIGHT, 4), (HEIGHT, 4)))
)
full = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementTetP2()), intorder=4)
basis = skfem.Basis(mesh, full.elem, intorder=2)
dofs, points = basis.element_dofs, basis.dx.shape[1]
slopes = torch.from_numpy(
    np.stack([b[0].grad for b in basis.basis]).transpose(3, 4, 0, 1, 2).reshape(-1, len(dofs), 9)
)
weights = torch.from_numpy(basis.dx.reshape(-1, 1, 1))


def internal(u):
    """Forces and stiffness of displacements."""
    F = eye + (torch.from_numpy(u[dofs.T]).repeat_interleave(points, 0)[:, None] @ slopes).reshape(-1, 3, 3)
    f = (weights * (slopes @ law.first_piola(F).reshape(-1, 9, 1))).reshape(-1, points, len(dofs)).sum(1)
    K = weights * (slopes @ law.tangent(F).reshape(-1, 9, 9) @ slopes.mT)
    K = K.reshape(-1, points, len(dofs), len(dofs)).sum(1).detach().numpy()
    rows, columns = np.broadcast_arrays(dofs.T[:, :, None], dofs.T[:, None])
    K = coo_matrix((K.ravel(), (rows.ravel(), columns.ravel())), (basis.N, basis.N))
    return np.bincount(dofs.T.ravel(), f.detach().numpy().ravel(), basis.N), K.tocsr()


H = np.array([[0.05, 0.1, 0.0], [0.0, -0.08, 0.04], [0.03, 0.0, 0.02]])
inner = basis.complement_dofs(basis.get_dofs())
f, _ = internal(full.project(lambda x: np.einsum("ij,j...->i...", H, x)))
print(f"patch test: residual {np.abs(f[inner]).max() / np.abs(f).max():.1e} of the boundary forces")

M = skfem.BilinearForm(lambda u, v, w: RHO * skfem.helpers.dot(u, v)).assemble(full)
gravity = M @ full.project(lambda x: np.stack([0 * x[0], 0 * x[0] - G, 0 * x[0]]))
free = basis.complement_dofs(basis.get_dofs(lambda x: x[0] < 1e-9))
tip = basis.get_dofs(lambda x: x[0] > LENGTH - 1e-9).all("u^2")
u, v, a, sag = np.zeros(basis.N), np.zeros(basis.N), np.zeros(basis.N), [0.0]
a[free] = spsolve(M[free][:, free].tocsc(), gravity[free])
for _ in range(STEPS):  # trapezoidal rule with Newton's method
    start = u + STEP * v + STEP**2 / 4 * a
    for _ in range(6):
        f, K = internal(u)
        residual = (gravity - f - M @ (u - start) * 4 / STEP**2)[free]
        u[free] += spsolve((K + 4 / STEP**2 * M)[free][:, free].tocsc(), residual)
        if np.linalg.norm(residual) < 1e-4 * np.linalg.norm(gravity):
            break
    v, a = v + STEP / 2 * (a + (u - start) * 4 / STEP**2), (u - start) * 4 / STEP**2
    sag.append(u[tip].mean())

space = 0.5 / CELLS
sites = np.indices((round((LENGTH + 0.1) / space), *(round(HEIGHT / space),) * 2)).reshape(3, -1).T
x = torch.from_numpy((sites + 0.5) * space + [0.2, 0.5, 0.5]).float()  # the clamp ends at a node of the grid
volume = torch.full((len(x),), space**3)
mpm = nm.MPM(CELLS, 2.5e-4, (0, -G, 0), clamps=(Clamp((0.1, 0.4, 0.4), (0.3, 0.7, 0.7)),))
state, every = nm.State(x, torch.zeros(3), RHO * volume, volume), round(STEP / mpm.dt)
path = nm.simulate(mpm, law, state, frames=range(0, STEPS * every + 1, every))
end = x[:, 0] > x[:, 0].max() - 1e-6
other = (path.x[:, end, 1].mean(1) - x[end, 1].mean()).numpy()
difference = np.sqrt(np.mean((other - sag) ** 2) / np.mean(np.square(sag)))
print(f"tip at {STEPS * STEP:g} s: {1e3 * sag[-1]:.2f} mm, in MPM {1e3 * other[-1]:.2f} mm")
print(f"root mean square of the difference: {100 * difference:.1f} % of that of the sag")
