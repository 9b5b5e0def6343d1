"""Differentiable material point method."""

from neuma_lib.sim.model import MPM, MaterialRegion, consecutive, contact_clearance
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State, Trajectory

__all__ = [
    "MaterialRegion",
    "MPM",
    "State",
    "Trajectory",
    "consecutive",
    "contact_clearance",
    "rollout",
]
