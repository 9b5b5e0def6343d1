"""Differentiable material point method: one rollout for data, fitting and evaluation."""

from neuma_lib.sim.model import Body, MPMModel, contact_clearance
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.trajectory import Trajectory

__all__ = ["Body", "MPMModel", "Trajectory", "contact_clearance", "rollout"]
