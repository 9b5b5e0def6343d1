"""Cases of `benchmarks.peers`, this project's rollout of them, and the child process that runs one engine.

As a script it serves one engine to its parent: it imports `neuma_lib` from the checkout on PYTHONPATH, this one or a
former one, and neither needs the other's files.
"""

import sys
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from importlib import import_module
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

ANALYTIC = {
    "neo_hookean": {"elasticity": {"name": "neo_hookean", "E": 1e4, "nu": 0.3}},
    "von_mises": {
        "elasticity": {"name": "hencky", "E": 1e4, "nu": 0.3},
        "plasticity": {"name": "von_mises", "yield_stress": 5e2},
    },
    "corotated_von_mises": {
        "elasticity": {"name": "fixed_corotated", "E": 1e4, "nu": 0.3},
        "plasticity": {"name": "von_mises", "yield_stress": 5e2},
    },
}
ENGINES = {
    "taichi": "benchmarks.peer_taichi:TaichiRollout",
    "genesis": "benchmarks.peer_genesis:GenesisRollout",
    "newton": "benchmarks.peer_newton:NewtonRollout",
}
"""Module and class of other engines by name."""


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

    @property
    def spec(self) -> dict[str, Any]:
        """Of an analytic law."""
        return ANALYTIC[self.law]

    def lame(self) -> tuple[float, float]:
        """Shear modulus and first Lame parameter [Pa]."""
        E, nu = (self.spec["elasticity"][name] for name in ("E", "nu"))
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


class Rollout(ABC):
    """A simulator prepared for a case on a device, "cpu" or "cuda"."""

    def start(self, work: str) -> None:  # noqa: B027
        """Return to the initial state, before `forward` or `forward_backward`. Not timed."""

    @abstractmethod
    def forward(self) -> None:
        """Simulate all steps without a gradient."""

    def forward_backward(self) -> None:
        """Simulate all steps and differentiate the final positions along the case's direction."""
        raise NotImplementedError

    @abstractmethod
    def result(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Final positions, and gradient of the initial velocities after `forward_backward`."""


class OwnRollout(Rollout):
    """This project's rollout, with the default contact, which nothing touches."""

    def __init__(self, case: Case, device: str):
        import torch

        from neuma_lib.mechanics.analytic import analytic_law
        from neuma_lib.mechanics.structured import structured_law
        from neuma_lib.sim import model
        from neuma_lib.sim.state import State

        torch.set_num_threads(1)
        x, v, m, vol0, direction = (torch.as_tensor(each).float().to(device) for each in case.arrays())
        of_all = torch.ones(len(x), device=device)
        self.state = State(x, v.requires_grad_(), m * of_all, vol0 * of_all)
        self.direction, self.steps = direction, case.steps
        constants = model.MPM if hasattr(model, "MPM") else model.MPMModel  # its name in commit c62e703
        self.model = constants(case.grid, case.dt, case.gravity)
        if case.law == "structured":
            self.law = structured_law({**ANALYTIC["von_mises"], "form": "stretch"})
            self.law.attach_adaptor(rank=None)
        else:
            self.law = analytic_law(case.spec)
        self.law.to(device)

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
        return self.x.detach().cpu().numpy(), self.state.v.grad.cpu().numpy()


def timed(engine: Rollout, work: str, device: str) -> tuple[float, float]:
    """Core and wall seconds of the second of two calls. The first fills the caches that other engines have used."""

    def clocks() -> tuple[float, float]:
        if device == "cuda":
            import torch

            torch.cuda.synchronize()  # waits for all streams of the device, of any library
        return time.process_time(), time.perf_counter()

    engine.start(work)
    getattr(engine, work)()
    engine.start(work)
    core, wall = clocks()
    getattr(engine, work)()
    core_end, wall_end = clocks()
    return core_end - core, wall_end - wall


def serve(name: str, device: str, parent: Connection) -> None:
    """Answer orders: work and fields of a `Case` with the engine's result, the name of a work with its seconds, None
    ends."""
    kind: Any = OwnRollout
    if name in ENGINES:
        module, own = ENGINES[name].split(":")
        kind = getattr(import_module(module), own)
    engine: Any = None
    while (order := parent.recv()) is not None:
        if isinstance(order, tuple):
            work, case = order
            engine = kind(Case(**case), device)
            engine.start(work)
            getattr(engine, work)()
            parent.send(engine.result())
        else:
            parent.send(timed(engine, order, device))


if __name__ == "__main__":
    serve(sys.argv[1], sys.argv[2], Connection(int(sys.argv[3])))
