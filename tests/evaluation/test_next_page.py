"""Page of the next experiment: sentences state what a record contains."""

from dataclasses import replace

import numpy as np
import torch
from PIL import Image

from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.evaluation.next_page import describe, draw, explain, page
from neuma_lib.fitting.next_experiment import Experiment, unfilmed
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.colliders import Collider
from neuma_lib.sim.rollout import rollout
from tests.support.grounding_scene import MODEL, TRUTH, ball, camera

LAUNCH = {
    "kind": "launch",
    "settings": {"height": 0.59, "velocity": [0.0, -1.2, 1.6], "spin": [0.0, 4.0, 3.0], "center": [0.5, 0.5]},
    "after": 0.12,
    "expected": {"G": 0.07, "K": 0.21},
    "becomes_determined": {},
    "log_bayes_factors": {"neo_hookean": 0.3},
}
CAMERA = {
    **LAUNCH,
    "kind": "camera",
    "settings": {"view": 2, "azimuth": -144, "elevation": 25},
    "expected": {"G": 0.06, "K": 0.09},
    "becomes_determined": {"K": {"before": 0.5, "after": 0.09}},
    "log_bayes_factors": {"neo_hookean": None},
}
RECORD = {
    "family": "hencky",
    "goal": "constants",
    "before": 0.2,
    "useful": True,
    "known": {"G": 0.08, "K": 0.5},
    "candidates": [LAUNCH, CAMERA],
}


def test_sentences_state_the_settings_and_the_gain():
    assert "height of 0.59 m with 2.0 m/s (1.2 m/s downwards) and a spin of 5.0 rad/s" in describe(LAUNCH)
    assert "turned by 90 degrees" in describe(
        {**LAUNCH, "settings": {**LAUNCH["settings"], "rotation": [0, 1.5708, 0]}}
    )
    assert "144 degrees to the left" in describe(CAMERA) and "25 degrees higher" in describe(CAMERA)
    assert explain(RECORD, LAUNCH) == "it is expected to lower the standard deviation of K from 50 % to 21 %."
    assert explain(RECORD, CAMERA) == (
        "it is expected to determine K (50 % to 9 %), and to distinguish hencky from neo_hookean."
    )
    predicted = {**LAUNCH, "prediction_std": 2e-3}
    assert "motion from 8 mm to 2 mm" in explain({**RECORD, "prediction_std": 8e-3}, predicted)


def test_a_press_and_a_hang_are_described():
    still = [0.0, 0.0, 0.0]
    poses = [[0.1, [0.5, 0.5, 0.5], still], [0.3, [0.5, 0.3, 0.5], still], [0.5, [0.5, 0.5, 0.5], still]]
    press = {"kind": "press", "settings": {"height": 0.15, "colliders": [{"keyframes": poses}]}}
    assert "height of 0.15 m and press it" in describe(
        press
    ) and "0.20 m and up again with 1.0 m/s" in describe(press)
    clamp = {
        "lowest": [0.3, 0.5, 0.3],
        "keyframes": [[0, still, still], [0.2, [0, 0.3, 0.4], still], [0.4, still, still]],
    }
    hang = {"kind": "hang", "settings": {"height": 0.4, "clamps": [clamp]}}
    assert "clamped above 0.50 m, move the clamp by 0.50 m (+0.30 m upwards) in 0.20 s and back" in describe(
        hang
    )
    assert "let it go" not in describe(hang)
    clamp["release"] = 0.35
    assert describe(hang).endswith("and let it go at 0.35 s")


def test_the_page_lists_every_candidate():
    text = page(RECORD, "next.png", "results/Duck")
    assert "![motions of the best candidates](next.png)" in text and "--from results/Duck" in text
    assert "| 1 | launch it" in text and "| 2 | film the first launch" in text
    assert "| 6 % | 9 % | K | excluded |" in text and "| 7 % | 21 % |  | 0.3 |" in text
    assert "\n1. Launch it" in text and "\n2. Film the first launch" in text
    assert "now 20 %" in text and "No candidate" not in text
    assert "No candidate" in page({**RECORD, "useful": False}, "next.png", "results/Duck")


def test_the_picture_has_a_row_for_each_motion(tmp_path):
    """The body is in the frames: the picture of a falling ball has more than the colours of frames and letters."""
    body, frames = ball(0.3), tuple(range(0, 61, 6))
    platen = Collider("box", (0.15, 0.02, 0.15), (0.5, 0.5, 0.5))
    motion = InitialMotion(
        np.array([0, -1.0, 0]), np.zeros(3), np.array([0.5, 0.3, 0.5]), np.eye(3), np.zeros(6)
    )
    with torch.no_grad():
        path = rollout(MODEL, analytic_law(TRUTH, MODEL.dt), body.state((0, -1, 0)), steps=60, frames=frames)
    heights = []
    models = (MODEL, replace(MODEL, colliders=(platen,)))
    for rows, model in enumerate(models, 1):
        own = Experiment(model, motion, body, [unfilmed(frames, camera())])
        draw(tmp_path / "next.png", [(own, path)] * rows)
        with Image.open(tmp_path / "next.png") as image:
            heights.append(image.height)
            coloured = sum(
                count for count, (r, g, b, _) in image.getcolors(2**24) if max(r, g, b) - min(r, g, b) > 60
            )
    assert heights[1] > 1.8 * heights[0] and coloured > 500
