"""Contacts that the report of a capture lists."""

import pytest

from neuma_lib.capture.report.motion import motion_report
from neuma_lib.sim.model import MPM
from tests.support.sim_scenes import make_law, moving_cube, simulate


@pytest.mark.parametrize("contact", ["particles", "nodes"])
def test_it_names_the_walls_that_the_body_touches(contact):
    """A cube that is 0.1 m from a wall at 2 m/s arrives after 0.05 s and stays for 2 side / c = 0.05 s."""
    model = MPM(16, 1e-3, gravity=(0.0, 0.0, 0.0), contact=contact)
    start, frames = moving_cube((2.0, 0.0, 0.0), centre=(0.8, 0.5, 0.5), side=0.2), (0, 30, 80)
    path = simulate(model, make_law("hencky"), start, frames)
    report = motion_report(model, path, start, frames, {"left": (0, 30, 80, 90), "right": (0, 30)})
    assert report["touched"] == ["x_max"] and report["contact_step"] == 80
    assert report["frames_after_contact"] == {"left": 1, "right": 0}
    before = motion_report(model, path.at(frames[:2]), start, frames[:2], {"left": (0, 30)})
    assert before["touched"] == [] and before["contact_step"] is None
