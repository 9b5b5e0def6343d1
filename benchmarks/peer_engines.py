"""Cases of `benchmarks.peers`, this project's rollout of them, and the child process that runs one engine.

As a script it serves one engine to its parent: it imports `neuma_lib` from the checkout on PYTHONPATH, this one or a
former one, and neither needs the other's files.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Protocol

import numpy as np

ANALYTIC = {
    "neo_hookean": {"elasticity": {"name": "neo_hookean", "E": 1e4, "nu": 0.3}},
    "von_mises": {
        "elasticity": {"name": "hencky", "E": 1e4, "nu": 0.3},
        "plasticity": {"name": "von_mises", "yield_stress": 5e2},
    },
}


@dataclass(frozen=True)
class Case:
    """A cube in free flight that stretches and shears.

    Attributes:
        law: a key of `ANALYTIC`, or "structured": the form "stretch" around Hencky and von Mises, untrained.
        particles: their number.
        grid: cells along an edge of the unit cube, eight particles a cell.
        steps: of the rollout.
        dt: time step [s].
        gravity: [m/s^2].
    """

    law: str
    particles: int
    grid: int
    steps: int = 50
    dt: float = 1e-3
    gravity: tuple[float, float, float] = (0.0, -9.8, 0.0)

    @property
    def title(self) -> str:
        return f"{self.law} {self.particles:,} / {self.grid}^3"

    def lame(self) -> tuple[float, float]:
        """Shear modulus and first Lame parameter [Pa]."""
        E, nu = (ANALYTIC[self.law]["elasticity"][name] for name in ("E", "nu"))
        return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))

    def arrays(self) -> tuple[np.ndarray, np.ndarray, float, float, np.ndarray]:
        """Positions [m] and velocities [m/s] (N, 3), mass [kg] and volume [m^3] of a particle, and the direction (N, 3)
        whose inner product with the final positions is differentiated."""
        generator = np.random.default_rng(0)
        spacing = 0.5 / self.grid
        side = int(np.ceil(self.particles ** (1 / 3) - 1e-9))
        sites = np.indices((side,) * 3).reshape(3, -1).T[: self.particles]
        offset = (sites - (side - 1) / 2 + generator.uniform(-0.2, 0.2, (self.particles, 3))) * spacing
        rate = np.array([[5.0, 7.0, 0.0], [0.0, -2.5, 3.0], [-5.0, 0.0, -2.5]])  # of stretch and shear [1/s]
        v = np.array([0.3, 0.5, 0.1]) + offset @ rate.T
        direction = generator.standard_normal((self.particles, 3))
        x, v, direction = (each.astype(np.float32) for each in (0.5 + offset, v, direction))
        return x, v, 1000 * spacing**3, spacing**3, direction


class Engine(Protocol):
    """A simulator prepared for a case."""

    def forward(self) -> None:
        """Simulate all steps without a gradient."""

    def forward_backward(self) -> None:
        """Simulate all steps and differentiate the final positions along the case's direction."""

    def result(self) -> tuple[np.ndarray, np.ndarray]:
        """Final positions and gradient of the initial velocities after `forward_backward`."""


class OwnRollout:
    """This project's rollout on one core, with the default contact, which nothing touches."""

    def __init__(self, case: Case):
        import torch

        from neuma_lib.mechanics.analytic import analytic_law
        from neuma_lib.mechanics.structured import structured_law
        from neuma_lib.sim import model
        from neuma_lib.sim.state import State

        torch.set_num_threads(1)
        x, v, m, vol0, direction = map(torch.as_tensor, case.arrays())
        of_all = torch.ones(len(x))
        self.state = State(x, v.requires_grad_(), m.float() * of_all, vol0.float() * of_all)
        self.direction, self.steps = direction, case.steps
        constants = model.MPM if hasattr(model, "MPM") else model.MPMModel  # its name in commit c62e703
        self.model = constants(case.grid, case.dt, case.gravity)
        if case.law == "structured":
            self.law = structured_law({**ANALYTIC["von_mises"], "form": "stretch"})
            self.law.attach_adaptor(rank=None)
        else:
            self.law = analytic_law(ANALYTIC[case.law])

    def _final_positions(self):
        from neuma_lib.sim.rollout import rollout

        options = dict(steps=self.steps, frames=[self.steps], skip_free_flight=False)
        return rollout(self.model, self.law, self.state, **options).x[0]

    def forward(self) -> None:
        import torch

        with torch.no_grad():
            self._final_positions()

    def forward_backward(self) -> None:
        self.state.v.grad = None
        self.law.zero_grad()
        self.x = self._final_positions()
        (self.x * self.direction).sum().backward()

    def result(self) -> tuple[np.ndarray, np.ndarray]:
        return self.x.detach().numpy(), self.state.v.grad.numpy()


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """Core and wall seconds of the second of two calls. The first fills the caches that other engines have used."""
    work()
    started = time.process_time(), time.perf_counter()
    work()
    return time.process_time() - started[0], time.perf_counter() - started[1]


def engine_for(name: str, case: Case) -> Engine:
    """Plain Taichi if the name is "taichi", else the rollout of the imported `neuma_lib`."""
    if name == "taichi":
        from benchmarks.peer_taichi import TaichiRollout

        return TaichiRollout(case)
    return OwnRollout(case)


def serve(name: str, parent: Connection) -> None:
    """Answer orders: fields of a `Case` with the engine's result, the name of a method with its seconds, None ends."""
    engine = None
    while (order := parent.recv()) is not None:
        if isinstance(order, dict):
            engine = engine_for(name, Case(**order))
            engine.forward_backward()
            parent.send(engine.result())
        else:
            parent.send(timed(getattr(engine, order)))


if __name__ == "__main__":
    serve(sys.argv[1], Connection(int(sys.argv[2])))
