"""Models of motion, which `Method.load` returns and which predict the states of bodies."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

from torch import Tensor

from neuma_lib.mechanics.law import Law
from neuma_lib.sim.bodies import Pair
from neuma_lib.sim.model import MPM, as_regions, consecutive
from neuma_lib.sim.prediction import Failure, predict
from neuma_lib.sim.state import State, Trajectory


class MotionModel(ABC):
    """Predicts the motion of a body.

    Attributes:
        law: the material law that the motion follows from, None if there is none.
        exported: that law for other simulators, which holds on any grid if it is another object.
        stable: whether the fit ended without divergence.
        constants: ``value`` and ``log_std`` of the constants of the exported law by name, None if they are unknown.
    """

    law: Law | None = None
    stable: bool = True
    constants: Mapping[str, Mapping[str, float]] | None = None

    @property
    def exported(self) -> Law | None:
        return self.law

    @abstractmethod
    def predict(
        self,
        mpm: MPM,
        state: State,
        frames: Sequence[int],
        tracers: Tensor | None = None,
        total: bool = False,
    ) -> tuple[Trajectory, Failure | None]:
        """States at the frames. After a failure the last valid state is repeated.

        Args:
            state: particles and their initial motion.
            frames: simulation steps, increasing.
            tracers: start positions of passive tracers [m], shape (M, 3).
            total: also carry the total deformation.
        """

    def courant(self, mpm: MPM, state: State) -> float | None:
        """Courant number of the simulation, None if it has none."""
        return None


class LawOnGrid(MotionModel):
    """Material laws in the material point method.

    Args:
        laws: one law a body.
        counts: number of particles of each body. None: one body.
        stable: whether all fits ended without divergence.
        exported: law of one body for other simulators. None: its law.
        friction: Coulomb coefficient of the body and its obstacles. None: those of the simulation, as for several
            bodies together.
        elsewhere: whether obstacles with a finite coefficient keep it.
        constants: of the exported law, see `MotionModel`.
        body: name of a body that touches others.
        pairs: Coulomb coefficients of pairs of bodies by their names, which replace those of the simulation where
            models of several bodies are put together.
    """

    def __init__(
        self,
        *laws: Law,
        counts: Sequence[int] | None = None,
        stable: bool = True,
        exported: Law | None = None,
        friction: float | None = None,
        elsewhere: bool = False,
        constants: Mapping[str, Mapping[str, float]] | None = None,
        body: str | None = None,
        pairs: Mapping[frozenset[str], float] | None = None,
    ):
        self.law, self.constants = laws[0], constants
        self.stable, self.friction, self.elsewhere = stable, friction, elsewhere
        self._exported = exported
        self._laws, self._counts = laws, counts
        self.body, self.pairs = body, pairs
        self._touching: tuple[Pair, ...] = ()

    @property
    def exported(self) -> Law:
        return self._exported or self.law

    @classmethod
    def together(cls, models: Sequence[MotionModel], counts: Sequence[int]) -> MotionModel:
        """One model of several bodies, whose particles follow each other. One model is returned unchanged."""
        if len(models) == 1:
            return models[0]
        together = cls(
            *(model.law for model in models), counts=counts, stable=all(model.stable for model in models)
        )
        names, pairs = [getattr(model, "body", None) for model in models], getattr(models[0], "pairs", None)
        together._touching = tuple(
            Pair(a, b, pairs[key])
            for a, b in combinations(range(len(names)), 2)
            if (key := frozenset((names[a], names[b]))) in (pairs or {})
        )
        return together

    def predict(self, mpm, state, frames, tracers=None, total=False):
        if self.friction is not None:
            mpm = mpm.with_friction(self.friction, given=not self.elsewhere)
        if self._touching:
            mpm = replace(mpm, pairs=self._touching)
        return predict(mpm, self._bodies(state), state, frames, tracers, total)

    def courant(self, mpm: MPM, state: State) -> float:
        bodies = as_regions(self._bodies(state), len(state.x))
        return max(mpm.courant(b.law, float(state.density[b.start : b.stop].min())) for b in bodies)

    def _bodies(self, state: State):
        laws = [law.to(state.x.device) for law in self._laws]
        return consecutive(laws, self._counts or [len(state.x)])
