"""Losses of laws on one reconstruction: that of the law that made the video is lowest, and tables say who is below."""

import csv

import pytest
import torch
from grounding_scene import MODEL, PRIOR, TRUTH, ball, observe

from neuma_lib.evaluation.bias import bias_report, bias_table, frame_losses
from neuma_lib.fitting.material import PixelLoss
from neuma_lib.mechanics.analytic import analytic_law

FRAMES = (0, 10, 55, 70)
V0 = torch.tensor([0.0, -1.5, 0.0], dtype=torch.float64)
FLOWING = {**TRUTH, "plasticity": {"name": "von_mises", "yield_stress": 50.0}}


def losses(body, video, spec, **options):
    law = analytic_law(spec, MODEL.dt)
    found, failure = frame_losses(MODEL, law, body.state(V0), PixelLoss(body, video, **options))
    assert failure is None
    return found


def test_the_law_of_the_video_has_no_loss_and_others_have_one_from_contact_on():
    body = ball()
    video = observe(body, V0, FRAMES)
    assert losses(body, video, TRUTH) == pytest.approx([0] * 4, abs=1e-20)
    wrong = losses(body, video, PRIOR)
    assert wrong[:2] == pytest.approx([0, 0], abs=1e-20) and min(wrong[2:]) > 1e-9
    assert losses(body, video, TRUTH, frames_per_batch=1) == losses(body, video, TRUTH)


def test_the_true_law_has_a_loss_where_gaussians_stretch_otherwise_than_those_of_the_video():
    body = ball()
    video = observe(body, V0, FRAMES, FLOWING)
    elastic, total = (losses(body, video, FLOWING, total=total) for total in (False, True))
    assert elastic == pytest.approx([0] * 4, abs=1e-20)
    assert total[:2] == pytest.approx([0, 0], abs=1e-20) and min(total[2:]) > 1e-9


def test_table_and_sentence():
    report = bias_report([1e-4, 3e-4], [2e-4, 6e-4])
    assert report["loss"] == pytest.approx(2e-4) and report["ratio"] == pytest.approx(0.5)

    def row(scene, method, loss, rmse):
        return {"scene": scene, "method": method, **bias_report([loss], [4e-4]), "tracer_rmse_mm": rmse}

    rows = [row(s, m, *found) for s, runs in SCENES.items() for m, found in runs.items()]
    titles = {"true_law": "True law", "neuma": "NeuMA", "nclaw": "NCLaw"}
    text, markdown, sentence = bias_table(rows, titles)
    # B is closer than the true law, C has no true law beside it, NCLaw has the higher loss.
    assert sentence.startswith("In 1 of 3 runs") and sentence.endswith(": NeuMA on A (0.50).")
    assert "| A | NeuMA | 4.000e-04 | 2.000e-04 | 0.50 | 7.00 |" in markdown and sentence in markdown
    lines = list(csv.DictReader(text.splitlines()))
    assert [float(line["ratio"]) for line in lines] == pytest.approx([r["ratio"] for r in rows])


SCENES = {
    "A": {"true_law": (4e-4, 3.0), "neuma": (2e-4, 7.0), "nclaw": (9e-4, 20.0)},
    "B": {"true_law": (4e-4, 3.0), "neuma": (2e-4, 2.0)},
    "C": {"neuma": (2e-4, 9.0)},
}
