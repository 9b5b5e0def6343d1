"""The motion of a body by fitted springs."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from neuma_lib.coupling.interpolation import Interpolation
from neuma_lib.io.weights import read_weights
from neuma_lib.methods.model import MotionModel
from neuma_lib.methods.spring_gaus.body import SpringBody
from neuma_lib.methods.spring_gaus.io import load_springs
from neuma_lib.methods.spring_gaus.network import Springs
from neuma_lib.methods.spring_gaus.rollout import SpringModel, spring_rollout
from neuma_lib.sim.model import MPM
from neuma_lib.sim.prediction import valid_frames
from neuma_lib.sim.state import State, Trajectory


class SpringMotion(MotionModel):
    """Springs of a file, on the body that they were fitted to or on another body of the same material.

    Another body gets a new network with one stiffness, that of the fitted network's modulus.

    Args:
        path: file of the springs.
        options: ``anchors``, ``neighbours``, ``hard_springs``, ``exponent`` and ``carriers`` of `SpringsConfig`.
    """

    def __init__(self, path: str, options: Mapping[str, Any]):
        self._path, self._options = path, options
        self.stable = read_weights(path)[1]["stable"]

    def predict(self, mpm: MPM, state: State, frames: Sequence[int], tracers=None, total=False):
        body, springs, about = self._on(state)
        model = SpringModel.of(mpm, about["substeps"])
        tracers = state.x[:0] if tracers is None else tracers
        follow = Interpolation(tracers, body.network.anchors, self._options["carriers"])

        def simulate(kept: Sequence[int]) -> Trajectory:
            x, v, _ = spring_rollout(model, springs, *body.start(state), kept)
            return body.path(tuple(kept), x, v, follow(x)[0])

        return valid_frames(simulate, frames)

    def _on(self, state: State) -> tuple[SpringBody, Springs, dict[str, Any]]:
        index, springs, about = load_springs(self._path, state.x)
        if index.max() < len(state.x) and torch.equal(state.x[index], springs.network.anchors):
            body = SpringBody.with_network(state.x, index, springs.network, self._options["carriers"])
            return body, springs, about
        body = SpringBody.of(
            state.x,
            *(
                self._options[name]
                for name in ("anchors", "neighbours", "hard_springs", "exponent", "carriers")
            ),
        )
        density = float(state.mass.sum() / state.vol0.sum())
        return body, springs.for_network(body.network, about["density"], density), about
