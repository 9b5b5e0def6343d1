"""Measures against their definitions written out, and the tables and films that show them."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
import yaml
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from neuma_lib.config.settings import load
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.evaluation.metrics import mean_height, psnr, ssim, tracer_rmse
from neuma_lib.evaluation.paper import PAPER, Claim, PaperTable
from neuma_lib.evaluation.reports import benchmark_table, learning_rate_table, report_table
from neuma_lib.evaluation.tables import chamfer_table
from neuma_lib.evaluation.video import side_by_side, write_mp4
from neuma_lib.geometry.chamfer import chamfer, chamfer_loss, chamfer_sequence

ROOT = Path(__file__).resolve().parents[2]


def points(*shape, seed=0):
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def brute_force(a, b):
    squared = (a[:, None] - b[None]).square().sum(-1)
    return squared.min(1).values.mean() + squared.min(0).values.mean()


def test_chamfer_is_its_definition():
    a, b = points(70, seed=1), points(45, seed=2)
    assert chamfer(a, b) == pytest.approx(1e4 * float(brute_force(a, b)), rel=1e-12)
    assert chamfer(a, b) == pytest.approx(chamfer(b, a), rel=1e-12)
    assert chamfer(a, a) == 0.0
    assert chamfer(torch.zeros(1, 3), torch.tensor([[0.03, 0, 0.04]])) == pytest.approx(2 * 25.0)


def test_chamfer_of_a_sequence_is_frame_by_frame():
    a, b = points(3, 50, seed=3), points(3, 40, seed=4)
    assert chamfer_sequence(a, b).tolist() == [chamfer(x, y) for x, y in zip(a, b, strict=True)]


def test_chamfer_loss_and_its_gradient():
    """Value against the definition for targets of any size; gradient against central differences."""
    x = points(3, 25, seed=5).requires_grad_()
    targets = [points(n, seed=10 + n) for n in (30, 18, 25)]
    loss = chamfer_loss(x, targets)
    torch.testing.assert_close(
        loss, torch.stack([brute_force(a, b) for a, b in zip(x, targets, strict=True)])
    )
    weights = torch.tensor([1.0, -0.5, 2.0], dtype=torch.float64)
    (gradient,) = torch.autograd.grad((weights * loss).sum(), x)
    for seed in range(5):
        direction = points(3, 25, seed=20 + seed) - 0.5
        h = 1e-6  # far below the distances at which a nearest neighbour changes
        with torch.no_grad():
            ahead, behind = (
                float((weights * chamfer_loss(x + s * direction, targets)).sum()) for s in (h, -h)
            )
        assert float((gradient * direction).sum()) == pytest.approx((ahead - behind) / (2 * h), rel=1e-7)


def test_chamfer_loss_names_what_is_wrong():
    with pytest.raises(InputError, match="2 frames against 1"):
        chamfer_loss(points(2, 5), [points(5)])
    broken = points(2, 5)
    broken[1, 3, 0] = float("nan")
    with pytest.raises(NonFiniteError, match="particle 3 of frame 1"):
        chamfer_loss(broken, points(2, 5))


def test_tracer_error_of_a_shift_is_its_length():
    path = points(4, 30)
    shift = torch.tensor([3e-3, 0.0, 4e-3], dtype=torch.float64)
    torch.testing.assert_close(tracer_rmse(path + shift, path), torch.full((4,), 5e-3, dtype=torch.float64))
    with pytest.raises(InputError, match="do not match"):
        tracer_rmse(path, path[:, 1:])


def test_mean_height_is_that_of_the_centre_of_mass():
    x = np.zeros((2, 2, 3))
    x[1, :, 1] = [1.0, 4.0]
    assert mean_height(x, np.array([2.0, 1.0])) == pytest.approx([0.0, 2.0])


def test_image_measures_agree_with_scikit_image():
    rng = np.random.default_rng(6)
    reference = rng.random((40, 32, 3))
    image = np.clip(reference + 0.1 * rng.standard_normal(reference.shape), 0, 1)
    expected = peak_signal_noise_ratio(reference, image, data_range=1)
    assert psnr(image, reference) == pytest.approx(expected, rel=1e-12)
    expected = structural_similarity(
        image, reference, channel_axis=-1, data_range=1, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False,
    )  # fmt: skip
    assert ssim(image, reference) == pytest.approx(expected, rel=1e-12)
    assert psnr(reference, reference) == float("inf") and ssim(reference, reference) == pytest.approx(1.0)


def test_unusable_points_and_images_are_named():
    with pytest.raises(InputError, match="not finite"):
        chamfer(points(4), torch.full((4, 3), float("inf")))
    with pytest.raises(InputError, match="non-empty"):
        chamfer(points(4), torch.zeros(0, 3))
    with pytest.raises(InputError, match="frames against"):
        chamfer_sequence(points(2, 4), points(3, 4))
    with pytest.raises(InputError, match="do not match"):
        psnr(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))
    with pytest.raises(InputError, match="smaller than the window"):
        ssim(np.zeros((8, 20, 3)), np.zeros((8, 20, 3)))


def run(value, **extra):
    return {
        "chamfer": value + 0.5, "chamfer_floor": 0.5, "chamfer_excess": value, "tracer_rmse_mm": 10 * value,
        "diverged_at_step": None, "stable": True, **extra,
    }  # fmt: skip


TITLES = {"nclaw": "NCLaw", "neuma": "NeuMA"}
SCENES = {scene: scene for scene in PAPER["table1"].columns}


def test_table_has_the_papers_rows_and_columns():
    metrics = {
        method: {scene: [run(k + i)] for i, scene in enumerate(SCENES)}
        for k, method in ((10, "nclaw"), (1, "neuma"))
    }
    table = chamfer_table(metrics, TITLES, SCENES, PAPER["table1"])
    rows = list(csv.DictReader(io.StringIO(table.csv())))
    assert [(r["quantity"], r["method"]) for r in rows] == [
        (quantity, method)
        for quantity in ("chamfer", "chamfer_excess", "tracer_rmse_mm")
        for method in TITLES
    ] + [("chamfer_floor", "floor")]
    assert list(rows[0])[3:-1] == [*SCENES, "Average"]
    assert float(rows[1]["Average"]) == pytest.approx(np.mean([1.5 + i for i in range(6)]))
    assert table.row("chamfer_excess", "nclaw").mean[list(SCENES).index("SandFish")] == 14
    text = table.markdown()
    assert (
        "| *paper: NCLaw* | 56.13 |" in text and "| 12.18 |" in text and "| Sampling floor | 0.50 |" in text
    )
    assert "PAC-NeRF" not in text and "†" not in text and "‡" not in text and "±" not in text


def test_table_is_open_for_more_methods():
    metrics = {"pac_nerf": {scene: [run(3.0)] for scene in SCENES}}
    text = chamfer_table(metrics, {"pac_nerf": "PAC-NeRF"}, SCENES, PAPER["table1"]).markdown()
    assert "| PAC-NeRF | 3.50 |" in text and "| *paper: PAC-NeRF* | 516.30 |" in text and "| 114.80 |" in text


def test_a_note_stands_below_the_table_and_its_sign_behind_the_row():
    metrics = {method: {scene: [run(3.0)] for scene in SCENES} for method in TITLES}
    text = chamfer_table(metrics, TITLES, SCENES, notes={"neuma": "Mind this."}).markdown()
    assert text.count("| NeuMA (1) |") == 3 and "| NCLaw |" in text and "\n(1) Mind this.\n" in text


def test_paper_averages_are_those_printed_there():
    printed = {
        "table1": {"pac_nerf": 114.80, "nclaw": 12.18, "neuma": 1.31, "neuma_particle_supervision": 1.51,
                   "neuma_without_binding": 6.60, "neuma_without_adaptor": 1.79},
        "table5": {"neuma+rank=4": 1.18, "neuma+rank=8": 1.10, "neuma": 1.04, "neuma+rank=24": 1.05},
    }  # fmt: skip
    for table, averages in printed.items():
        assert set(averages) == set(PAPER[table].rows)
        for method, average in averages.items():
            assert np.mean(PAPER[table].rows[method]) == pytest.approx(average, abs=7e-3), method


def test_tables_of_the_paper_are_whole():
    settings = load(yaml.safe_load((ROOT / "config" / "config.yaml").read_text()), ROOT)
    for name, paper in PAPER.items():
        table = settings.tables[name]
        assert tuple(paper.columns) == (*table.scenes, *table.experiments)
        assert set(paper.rows) - {"pac_nerf"} <= set(table.methods)
        for claim in paper.claims:
            assert {*claim.better, *claim.worse} <= set(table.methods)
            assert set(claim.columns) <= set(paper.columns)
        assert all(len(row) == len(paper.columns) for row in paper.rows.values())


def test_diverged_runs_are_marked_and_explained():
    metrics = {
        "nclaw": {"BouncyBall": [run(5.0)], "Other": [run(4.0, diverged_at_step=80)]},
        "neuma": {"BouncyBall": [run(1.0, stable=False)], "Other": [run(2.0)]},
    }
    table = chamfer_table(metrics, TITLES, {"BouncyBall": "Ball", "Other": "Other"}, PAPER["table1"])
    text = table.markdown()
    assert "| Method | Ball | Other | Average |" in text
    assert "| NCLaw | 5.50 | 4.50‡ | 5.00 |" in text and "| NeuMA | 1.50† | 2.50 | 2.00 |" in text
    assert "† The training diverged" in text and "‡ The predicted motion became non-finite" in text
    assert "paper: NeuMA" not in text, "the paper has no such column"
    rows = list(csv.DictReader(io.StringIO(table.csv())))
    assert rows[0]["diverged"] == "Other" and rows[1]["diverged"] == "BouncyBall"


def test_a_missing_or_broken_cell_is_named():
    column = {"BouncyBall": "BouncyBall"}
    with pytest.raises(InputError, match="no metrics.json of neuma on BouncyBall"):
        chamfer_table({"nclaw": {"BouncyBall": [run(1.0)]}}, TITLES, column)
    broken = {"nclaw": {"BouncyBall": [run(float("nan"))]}}
    with pytest.raises(InputError, match="nclaw on BouncyBall is nan"):
        chamfer_table(broken, {"nclaw": "NCLaw"}, column)


def test_several_seeds_give_mean_and_standard_deviation():
    metrics = {
        "nclaw": {"a": [run(5.0)], "b": [run(7.0)]},
        "neuma": {"a": [run(1.0), run(2.0), run(3.0)], "b": [run(2.0), run(2.0), run(5.0)]},
    }
    table = chamfer_table(metrics, TITLES, {"a": "a", "b": "b"})
    text = table.markdown()
    # Excesses of the seeds average 1.5, 2 and 4.
    assert "| NeuMA | 2.00 ± 1.00 | 3.00 ± 1.73 | 2.50 ± 1.32 |" in text
    assert "| NCLaw | 5.00 | 7.00 | 6.00 |" in text and "± is the standard deviation over chains" in text
    rows = {(r["quantity"], r["method"]): r for r in csv.DictReader(io.StringIO(table.csv()))}
    assert float(rows["chamfer_excess_std", "neuma"]["Average"]) == pytest.approx(1.3229, abs=1e-4)
    assert ("chamfer_excess_std", "nclaw") not in rows and ("chamfer_floor_std", "floor") not in rows


def test_claims_are_judged_by_the_numbers():
    paper = PaperTable(
        "tab:x",
        "X",
        "x",
        ("a", "b"),
        {"neuma": (1.0, 2.0), "nclaw": (3.0, 3.0), "other": (2.0, 5.0)},
        (
            Claim("NeuMA is best, w/ P.S.", ("neuma",), ("nclaw", "other")),
            Claim("others are best", ("nclaw", "other"), ("neuma",), ("b",)),
            Claim("nobody prints this", ("neuma",), ("nclaw",), by_paper=False),
            Claim("of a row that is not here", ("neuma",), ("pac_nerf",)),
        ),
    )
    excesses = {"neuma": (1.0, 2.0), "nclaw": (4.0, 1.0), "other": (5.0, 6.0)}
    metrics = {m: {c: [run(v)] for c, v in zip("ab", values)} for m, values in excesses.items()}
    titles = TITLES | {"other": "Other"}
    table = chamfer_table(metrics, titles, {"a": "a", "b": "b"}, paper)
    best, others, unprinted = table.verdicts()
    assert best == (
        "Holds: NeuMA is best, w/ P.S. Excess 1.500 (NeuMA) against 2.500 (NCLaw) on average; it is so in"
        " 1 of 2 columns. Paper, floors included: 1.50 against 3.00."
    )
    assert others.startswith("Does not hold: others are best. Excess 6.000 (Other) against 2.000 (NeuMA)")
    assert others.endswith("in 0 of 1 columns. Paper, floors included: 5.00 against 2.00.")
    assert unprinted.startswith("Holds") and unprinted.endswith("The paper does not compare these.")
    assert f"- {best}\n" in table.markdown()


def test_benchmarks_stand_beside_the_papers():
    scene = {
        "shape": "ball", "size": 0.26, "height": 0.28, "velocity": [0.0, -1.92, 0.0], "density": 1000.0,
        "dt": 1e-3, "steps": 256, "prior": "jelly",
        "law": {"elasticity": {"name": "fixed_corotated", "E": 3e4, "nu": 0.45}, "plasticity": {"name": "identity"}},
    }  # fmt: skip
    thrown = scene | {
        "velocity": [0.5, -1.0, 0.0],
        "density": {"axis": "x", "at": 0.5, "below": 1, "above": 2},
    }
    table, text = benchmark_table({"BouncyBall": scene, "JellyDuck": thrown, "Own": thrown})
    rows = {row["benchmark"]: row for row in csv.DictReader(io.StringIO(table))}
    assert rows["BouncyBall"]["elasticity"] == "fixed corotated: E 30000, nu 0.45"
    assert rows["BouncyBall"]["dynamics"] == "Bouncy" and rows["Own"]["dynamics"] == ""
    assert "are the paper's (tab:benchmark_details) for BouncyBall." in text
    assert "(0.5, -1, 0) (*paper: (0, -1.62, 0)*)" in text and "differ from it for JellyDuck" in text


def test_report_table_has_a_line_a_row():
    text, markdown = report_table({"a": {"n": 3, "q": 0.123456}}, {"n": "count", "q": "quality"}, "scene")
    assert text == "scene,n,q\na,3,0.123456\n"
    assert markdown.splitlines()[-1] == "| a | 3 | 0.1235 |"


@pytest.fixture
def film():
    """A bright square that moves to the right over ten frames."""
    frames = np.zeros((10, 33, 41, 3))
    for t, frame in enumerate(frames):
        frame[10:20, 3 * t : 3 * t + 10] = (1.0, 0.5, 0.2)
    return frames


def test_video_shows_both_panels_and_is_the_same_every_time(film, tmp_path):
    video = side_by_side([film, 1 - film], ["observation", "prediction"], magnify=2)
    assert video.dtype == np.uint8 and video.shape == (10, 2 * 33 + 18, 2 * 2 * 41, 3)
    for name in ("first.mp4", "second.mp4"):
        write_mp4(tmp_path / name, video, frame_rate=12)
    assert (tmp_path / "first.mp4").read_bytes() == (tmp_path / "second.mp4").read_bytes()
    read = np.stack(imageio.mimread(tmp_path / "first.mp4"))
    assert read.shape == video.shape
    # The step of H.264 at QP 18, 0.625 * 2^(18 / 6), is 5 levels: its orthonormal transform leaves pixels at most half
    # of that off in quadratic mean. Blocks of 2 x 2 equal pixels lose nothing to the coarser colour planes.
    apart = [[np.sqrt(np.square(a - b).mean()) for b in video.astype(float)] for a in read.astype(float)]
    assert max(np.diag(apart)) < 2.5
    # A frame more or less would be noticed: neighbours are further apart.
    assert (np.argmin(apart, axis=1) == range(10)).all() and np.diag(apart, 1).min() > 5


def test_learning_rate_is_chosen_by_the_geometric_mean_of_the_training_loss():
    def run(scale, scene, best, excess):
        return {
            "method": "neuma", "lr_scale": scale, "scene": scene, "loss": [1.0, best], "best_loss": best,
            "stable": True, "recoveries": [], "chamfer_excess": excess,
        }  # fmt: skip

    # The arithmetic mean and the excess, which knows the truth, would both choose the other factor.
    rows = [run(0.5, "a", 0.001, 9), run(0.5, "b", 0.3, 9), run(1.0, "a", 0.1, 1), run(1.0, "b", 0.1, 1)]
    table, markdown, best = learning_rate_table(rows)
    assert best == {"neuma": 0.5}
    read = list(csv.DictReader(io.StringIO(table)))
    assert [float(row["ratio"]) for row in read] == [0.001, 0.3, 0.1, 0.1]
    assert "neuma ×0.5" in markdown


def test_unusable_videos_are_named(film):
    with pytest.raises(InputError, match="differ in length"):
        side_by_side([film, film[:5]], ["a", "b"])
    with pytest.raises(InputError, match="1 labels for 2"):
        side_by_side([film, film], ["a"])
    with pytest.raises(InputError, match="expected frames"):
        side_by_side([film[0]], ["a"])
    with pytest.raises(InputError, match="not finite"):
        side_by_side([film * np.nan], ["a"])
