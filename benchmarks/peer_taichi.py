"""Differentiable MLS-MPM of a neo-Hookean body in plain Taichi, the way its users write it.

MLS-MPM (Hu et al. 2018) differentiated as in DiffTaichi (Hu et al. 2020): particles with a time axis, kernels `p2g`,
`grid_update` and `g2p`, and a reverse loop over their `.grad` kernels. The grid has no time axis: the reverse loop
computes it again, as DiffTaichi's 3D example does. Equations and order of a step are those of `neuma_lib.sim.kernels`:
quadratic B-splines, APIC, F updated in `g2p`. There are no walls, colliders or checks for faults.

Loops over the 27 nodes of a particle are unrolled, as in DiffTaichi. Reverse mode of Taichi 1.7.4 gave wrong gradients
of these kernels without unrolling, and also with `cfg_optimization=False`, which compiles faster. The kernels compile
in a minute and are cached on disk.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of kernels as objects.
import numpy as np
import taichi as ti

from benchmarks.peer_engines import Case, Rollout

VECTORS = ti.types.ndarray(dtype=ti.math.vec3, ndim=1)
MIN_MASS = 1e-12
"""Mass of a node with a velocity [kg]. The adjoint of (m v) / m divides by m^2, which underflows for smaller masses."""


@ti.func
def spline(f):
    """Weights of the three nodes of each axis, at the distances f from the first [dx]: w[i][a] of node i, axis a."""
    return [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2]


@ti.data_oriented
class TaichiRollout(Rollout):
    """Rollout of a case: `forward`, and `forward_backward` to the gradient of the initial velocities."""

    def __init__(self, case: Case, device: str):
        if case.law != "neo_hookean":
            raise ValueError(f"{case.law} is not implemented in Taichi")
        arch = ti.cuda if device == "cuda" else ti.cpu
        ti.init(arch=arch, cpu_max_num_threads=1, default_fp=ti.f32, log_level=ti.ERROR)
        self.serial = device == "cpu"
        x, v, self.m, self.vol0, direction = case.arrays()
        self.steps, self.n, self.dt = case.steps, case.grid, case.dt
        self.mu, self.lam, self.gravity = *case.lame(), ti.Vector(case.gravity)
        time, nodes = (case.steps + 1, len(x)), (case.grid,) * 3
        self.x, self.v = (ti.Vector.field(3, ti.f32, shape=time, needs_grad=True) for _ in range(2))
        self.F, self.C = (ti.Matrix.field(3, 3, ti.f32, shape=time, needs_grad=True) for _ in range(2))
        self.mv, self.grid_v = (ti.Vector.field(3, ti.f32, shape=nodes, needs_grad=True) for _ in range(2))
        self.grid_m = ti.field(ti.f32, shape=nodes, needs_grad=True)
        self.direction = ti.Vector.field(3, ti.f32, shape=len(x))
        self.direction.from_numpy(direction)
        self.initialise(x, v)

    @ti.kernel
    def initialise(self, x: VECTORS, v: VECTORS):
        """Initial state."""
        for p in range(self.x.shape[1]):
            self.x[0, p] = x[p]
            self.v[0, p] = v[p]
            self.F[0, p] = ti.Matrix.identity(ti.f32, 3)

    @ti.kernel
    def clear_grid(self):
        for node in ti.grouped(self.grid_m):
            self.mv[node] = ti.Vector.zero(ti.f32, 3)
            self.grid_m[node] = 0.0

    @ti.kernel
    def clear_grid_adjoint(self):
        for node in ti.grouped(self.grid_m):
            self.mv.grad[node] = ti.Vector.zero(ti.f32, 3)
            self.grid_v.grad[node] = ti.Vector.zero(ti.f32, 3)
            self.grid_m.grad[node] = 0.0

    @ti.kernel
    def p2g(self, s: ti.i32):
        """m_i += w_i m, (m v)_i += w_i (m v + A d_i) with A = dx (m C - dt vol0 (4 / dx^2) tau), d_i = (x_i - x) / dx.

        With columns a, b and c of A this is w_i (q + i a + j b + k c).
        """
        ti.loop_config(serialize=self.serial)  # one thread needs no atomic additions
        for p in range(self.x.shape[1]):
            F = self.F[s, p]
            tau = self.mu * (F @ F.transpose()) + ti.Matrix.identity(ti.f32, 3) * (
                self.lam * ti.log(F.determinant()) - self.mu
            )
            A = (self.m / self.n) * self.C[s, p] - (self.dt * self.vol0 * 4.0 * self.n) * tau
            cells = self.x[s, p] * self.n
            base = ti.cast(cells - 0.5, ti.i32)
            f = cells - base
            w = spline(f)
            q = self.m * self.v[s, p] - A @ f
            a, b, c = A[:, 0], A[:, 1], A[:, 2]
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                weight = w[i][0] * w[j][1] * w[k][2]
                node = base + ti.Vector([i, j, k])
                self.mv[node] += weight * (q + i * a + j * b + k * c)
                self.grid_m[node] += weight * self.m

    @ti.kernel
    def grid_update(self):
        """v_i = (m v)_i / m_i + dt g where there is mass."""
        for node in ti.grouped(self.grid_m):
            v = ti.Vector.zero(ti.f32, 3)
            if self.grid_m[node] > MIN_MASS:
                v = self.mv[node] / self.grid_m[node] + self.dt * self.gravity
            self.grid_v[node] = v

    @ti.kernel
    def g2p(self, s: ti.i32):
        """v = sum w_i v_i,  C = (4 / dx) sum w_i v_i d_i^T,  x += dt v,  F = (I + dt C) F."""
        ti.loop_config(serialize=self.serial)  # one thread needs no atomic additions
        for p in range(self.x.shape[1]):
            cells = self.x[s, p] * self.n
            base = ti.cast(cells - 0.5, ti.i32)
            f = cells - base
            w = spline(f)
            v = ti.Vector.zero(ti.f32, 3)
            a, b, c = ti.Vector.zero(ti.f32, 3), ti.Vector.zero(ti.f32, 3), ti.Vector.zero(ti.f32, 3)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                weight = w[i][0] * w[j][1] * w[k][2]
                own = weight * self.grid_v[base + ti.Vector([i, j, k])]
                v += own
                a += i * own
                b += j * own
                c += k * own
            C = (4.0 * self.n) * (ti.Matrix.cols([a, b, c]) - v.outer_product(f))
            self.v[s + 1, p] = v
            self.C[s + 1, p] = C
            self.x[s + 1, p] = self.x[s, p] + self.dt * v
            self.F[s + 1, p] = self.F[s, p] + self.dt * (C @ self.F[s, p])

    @ti.kernel
    def start_adjoint(self):
        """Gradient of sum(direction x) with respect to the final state, and zero for all other states."""
        for s, p in self.x:
            self.x.grad[s, p] = ti.Vector.zero(ti.f32, 3)
            self.v.grad[s, p] = ti.Vector.zero(ti.f32, 3)
            self.C.grad[s, p] = ti.Matrix.zero(ti.f32, 3, 3)
            self.F.grad[s, p] = ti.Matrix.zero(ti.f32, 3, 3)
        for p in self.direction:
            self.x.grad[self.steps, p] = self.direction[p]

    def to_grid(self, s: int) -> None:
        """Momentum, mass and velocity of the nodes in step s."""
        self.clear_grid()
        self.p2g(s)
        self.grid_update()

    def forward(self) -> None:
        for s in range(self.steps):
            self.to_grid(s)
            self.g2p(s)

    def forward_backward(self) -> None:
        self.forward()
        self.start_adjoint()
        for s in reversed(range(self.steps)):
            self.to_grid(s)
            self.clear_grid_adjoint()
            self.g2p.grad(s)
            self.grid_update.grad()
            self.p2g.grad(s)

    def result(self) -> tuple[np.ndarray, np.ndarray]:
        """Final positions and gradient of the initial velocities after `forward_backward`."""
        return self.x.to_numpy()[-1], self.v.grad.to_numpy()[0]
