"""The workflow as a user runs it: real Snakemake, every stage, on a setting of two minutes (tiny.yaml)."""

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.laws import load_law
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.paper.image_grid import load_image_grid
from neuma_lib.sim.model import MPM
from tests.support import full_run
from tests.support.errors import refused
from tests.support.project import SCENE, TABLE, Plan, Project, copied, overlay, wait_for

LONGER = (*overlay(training={"iterations": 9}), TABLE)

# ---- from nothing to a table


def test_table_from_nothing(finished):
    table = (finished.root / TABLE).read_text().splitlines()
    assert table[0].startswith("quantity,method,title,BouncyBall,Average")
    rows = {tuple(line.split(",")[:2]) for line in table[1:]}
    assert {
        ("tracer_rmse_mm", "nclaw"),
        ("tracer_error_p95_mm", "neuma"),
        ("chamfer", "neuma"),
        ("chamfer_floor", "floor"),
    } <= rows
    assert "| NeuMA |" in (finished.root / "tiny/results/table1.md").read_text()
    assert (finished.root / SCENE / "neuma" / "video.mp4").stat().st_size > 1000


@pytest.mark.parametrize(
    "stage", ["ground_truth", "render_static", "gaussians", "mesh", "binding", "velocity", "fit_neuma"]
)
def test_every_stage_reports_its_result_and_logs_it(finished, stage):
    reports = re.findall(rf"^{stage} .*?: .*\d.*$", finished.output, re.MULTILINE)
    assert reports
    log = next((finished.root / "tiny/results/logs").rglob(f"{stage}.log"))
    assert reports[-1].split(": ", 1)[1] in log.read_text()


def test_same_seed_same_bytes_in_another_folder(finished, kernels, tmp_path):
    again = copied(tmp_path / "elsewhere", kernels, finished.root)
    again.run(TABLE, f"{SCENE}/initial_state.json", f"{SCENE}/neuma/video.mp4")
    first, second = finished.artifacts(), again.artifacts()
    assert first == second
    assert {Path(name).name for name in first} >= {
        *("truth.h5", "particles.h5", "sampled_particles.h5", "transforms.json", "gaussians.ply", "mesh.ply"),
        *("binding.h5", "velocity.json", "jelly.safetensors", "adaptor.safetensors", "rollout.h5"),
        *("metrics.json", "video.mp4", "table1.csv"),
    }
    for name in first:
        assert str(finished.root).encode() not in (finished.root / name).read_bytes(), name


# ---- what runs again, and what does not


def test_nothing_to_do_when_nothing_but_the_kernel_cache_changed(finished, tmp_path):
    """A cache that others filled or emptied repeats no job. Variants have their own folders."""
    variants = [
        f"{SCENE}/neuma+{name}/metrics.json" for name in ("rank=2+seed=3", "rank=3", "assumed_density=900")
    ]
    plan = finished.plan(*overlay(kernel_cache=str(tmp_path)), TABLE, *variants)
    assert plan.behind(TABLE) == {}
    assert [plan.behind(file) for file in variants] == 3 * [{"fit_neuma": 1, "evaluate": 1}]


def test_times_comments_and_docstrings_rerun_nothing(clone):
    """Times are random, as after a clock that jumped."""
    years = random.Random(0)
    for folder in ("neuma_lib", "workflow", "config", "tests", "envs", "tiny"):
        for file in (clone.root / folder).rglob("*"):
            if file.is_file():
                os.utime(file, 2 * (years.uniform(1e9, 3e9),))
    for name in ("neuma_lib/splatting/rasterizer.py", "workflow/scripts/fit.py"):
        file = clone.root / name
        file.write_text(re.sub(r'^"""', '"""Reworded. ', file.read_text(), count=1) + "\n# a remark\n")
    assert clone.plan(TABLE) == {}


def test_a_deleted_method_is_made_again_for_its_table(clone):
    shutil.rmtree(clone.root / SCENE / "neuma")
    assert clone.plan(TABLE) == {"fit_neuma": 1, "evaluate": 1, "chamfer_table": 1}


def test_editing_the_rasterizer_reruns_what_renders(clone):
    """Of other edits, test_provenance.py computes what they rerun."""
    file = clone.root / "neuma_lib" / "splatting" / "rasterizer.py"
    file.write_text(file.read_text() + "\nEDITED = True\n")
    truth = clone.root / "tiny/data/BouncyBall/truth.h5"
    written = truth.stat().st_mtime_ns
    assert Plan.of(clone.run(f"{SCENE}/gaussians.ply")) == {"kernels": 1, "gaussians": 1}
    assert truth.stat().st_mtime_ns == written
    plan = clone.plan(TABLE)
    # The mesh of one of several bodies is made from views with the others rendered away.
    assert {"mesh", "binding", "velocity", "fit_neuma", "evaluate", "chamfer_table"} <= set(plan)
    spared = {"kernels", "gaussians", "ground_truth", "render_static", "render_dynamic", "prior"}
    assert not spared & set(plan)


# ---- everything else that can be made of the scene


def test_learned_laws_move_other_bodies_and_images_are_measured(full):
    """A letter above the reconstructed ball, both with the learned law; stand-in weights for LPIPS."""
    # Lines of jobs that run at the same time may be mixed in the output.
    log = full.root / "tiny/results/logs/experiments/letter_and_ball/experiment_start.log"
    assert (
        "experiment_start experiments/letter_and_ball: " in full.output and "] 2 bodies, " in log.read_text()
    )
    folder = full.root / "tiny/results/experiments/letter_and_ball"
    letter, ball = json.loads((folder / "velocity.json").read_text())["bodies"]
    assert letter["v0"] == [0, -2, 0] and letter["angular_velocity"] == [0, 0, 0]
    estimate = json.loads((full.root / SCENE / "velocity.json").read_text())
    assert all(ball[key] == estimate[key] for key in ("v0", "angular_velocity", "centre"))
    path, _ = read_arrays(folder / "nclaw" / "rollout.h5")
    assert path["x"].shape[1] == letter["particles"] + ball["particles"]
    split = letter["particles"]
    assert path["x"][0, :split, 1].min() > path["x"][0, split:, 1].max()
    # They meet: in free fall the letter would be below the floor.
    fallen = path["x"][0, :split, 1].mean() - path["x"][-1, :split, 1].mean()
    assert 0.05 < fallen < 0.45 < 2.0 * 0.18 + 0.5 * 9.8 * 0.18**2
    header, *rows = (full.root / "tiny/results/table2.csv").read_text().splitlines()
    assert header.startswith("quantity,method,title,letter_and_ball,Average")
    assert rows[0].startswith("tracer_rmse_mm,nclaw,the prior,") and len(rows) == 11
    assert "BouncyBall" in (full.root / "tiny/results/table4.csv").read_text()
    measured = json.loads((full.root / SCENE / "neuma" / "image_metrics.json").read_text())
    assert measured["views"] == [1] and measured["views_seen_in_training"] == []
    assert len(measured["ssim_per_frame"]) == 7
    assert measured["psnr"] > 8 and measured["lpips_vgg"] != 0


def test_pac_nerf_is_evaluated_and_displayed_on_its_own_particles(full):
    """The particles of the field move, have tracers and are rendered. So short a fit identifies no law."""
    folder = full.root / full_run.OWN_PARTICLES
    simulated, displayed = re.search(r"(\d+) of (\d+) particles simulated", full.output).groups()
    x = read_arrays(folder / "rollout.h5", only=("x",))[0]["x"]
    shared = read_arrays(full.root / SCENE / "neuma" / "rollout.h5", only=("x",))[0]["x"]
    assert x.shape == (7, int(simulated), 3) and int(simulated) < int(displayed)
    assert abs(x[0].mean(0) - shared[0].mean(0)).max() < 0.03 and x.shape != shared.shape
    assert json.loads((folder / "metrics.json").read_text())["tracer_rmse_mm"] > 0
    grid = load_image_grid(full.root / "tiny/results/figures/main_res.h5")
    assert grid.rows == ("Observation", "NCLaw", "NeuMA", "PAC-NeRF, own particles, views 0,1")
    observed, _, splatted, rendered = (row[0].astype(int) for row in grid.images)
    masks = [(image < 200).any(-1) for image in (observed, rendered)]
    assert (masks[0] & masks[1]).sum() > 0.5 * (masks[0] | masks[1]).sum()
    assert abs(rendered - splatted).max() > 20, "images of the field, not of Gaussians"


def test_a_replicate_of_another_seed_repeats_everything_that_is_drawn(finished, full):
    before, after = finished.artifacts(), full.artifacts()
    assert all(after[name] == digest for name, digest in before.items())
    replicates = {name: name.replace("BouncyBall/", "BouncyBall+seed=1/") for name in before if SCENE in name}
    replicates["tiny/results/priors/jelly.safetensors"] = "tiny/results/priors/jelly+seed=1.safetensors"
    repeated = {name: other for name, other in replicates.items() if other in after}
    assert {Path(name).name for name in repeated} >= {
        *("jelly.safetensors", "gaussians.ply", "mesh.ply", "particles.h5", "velocity.json"),
        *("adaptor.safetensors", "rollout.h5", "metrics.json"),
    }
    assert [name for name, other in repeated.items() if after[name] == after[other]] == []
    _, *rows = (full.root / full_run.REPLICATES).read_text().splitlines()
    spreads = {row.split(",")[1] for row in rows if row.startswith("chamfer_std,")}
    assert spreads == {"nclaw", "neuma"}


def test_the_true_law_is_evaluated_without_training_or_prior(full):
    target = f"{SCENE}/true_law/metrics.json"
    assert full.ran.behind(target) == {"evaluate": 1}
    assert not any("priors/" in file for file in full.ran.makers[target].inputs)
    true, prior = (
        json.loads((full.root / SCENE / m / "metrics.json").read_text()) for m in ("true_law", "nclaw")
    )
    # The tiny scene is short: the error of the start, which all laws share, is nearly all of both errors.
    assert 0 < true["tracer_rmse_mm"] < 1.1 * prior["tracer_rmse_mm"] and true["stable"]
    # The wave speed tells which law was simulated.
    law = analytic_law({"elasticity": {"name": "fixed_corotated", "E": 3e4, "nu": 0.45}}, dt=2e-3)
    assert true["courant"] == pytest.approx(MPM(grid=14, dt=2e-3).courant(law, 1000.0), rel=1e-6)
    assert prior["courant"] != pytest.approx(true["courant"], rel=1e-4)


def test_the_demo_makes_a_page_and_a_law_that_a_scene_can_start_from(full, clone):
    assert "error of the motion: NCLaw" in full.output and f"{SCENE}/viewer.html" in full.output
    page = (full.root / "tiny/results/demo.md").read_text()
    linked = {name for name in re.findall(r"BouncyBall/[\w./]+", page)}
    files = {"film.gif", "film.mp4", "law.safetensors", "law.png", "viewer.html"}
    assert {Path(name).name for name in linked} == files
    for name in linked:
        assert (full.root / "tiny/results" / name).stat().st_size > 1000, name
    law = clone.root / "law.safetensors"
    shutil.copy(full.root / SCENE / "neuma/export/law.safetensors", law)
    changed = overlay(scenes={"BouncyBall": {"prior": law.name}})
    clone.run(*changed, f"{SCENE}/neuma+iterations=1/adaptor.safetensors")
    # a law of networks at the step of another scene
    with refused("law.safetensors", "dt") as caught:
        load_law(law, dt=1e-3)
    assert "the law was trained at a time step of 0.002 s" in str(caught.value)


# ---- failures


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_without_the_requested_gpu_nothing_is_begun(kernels, tmp_path):
    project = copied(tmp_path, kernels)
    cuda = overlay(device="cuda")
    output = project.run(*cuda, f"{SCENE}/neuma/adaptor.safetensors", succeeds=False)
    assert re.search(r"^fit_neuma +1$", output, re.MULTILINE), "it can be planned"
    assert "torch sees no CUDA device" in output and "fit_neuma, gaussians, velocity" in output
    assert "Traceback (most recent call last)" not in output
    assert not (tmp_path / "tiny").exists()
    assert "ground_truth BouncyBall: " in project.run(*cuda, "tiny/data/BouncyBall/truth.h5")


@pytest.fixture(scope="module")
def failed(finished, tmp_path_factory):
    """A copy in which a changed training, one with another run's checkpoint, and one of a damaged image have failed."""
    project = finished.clone(tmp_path_factory.mktemp("failed") / "project")
    (project.root / SCENE / "neuma/checkpoint.pt").write_text("damaged")
    Checkpoint(project.root / SCENE / "neuma+seed=7/checkpoint.pt", {"setting lr_elastic": "1.0"}).save(
        {"iteration": 1, "weights": torch.zeros(3)}
    )
    image = project.root / "tiny/data/BouncyBall/static/s_003.png"
    content = image.read_bytes()
    image.write_bytes(content[:-100])
    targets = (f"{SCENE}/neuma+seed=7/adaptor.safetensors", f"{SCENE}+seed=1/gaussians.ply")
    project.output = project.run("--keep-going", *LONGER, *targets, succeeds=False)
    image.write_bytes(content)
    return project


def test_a_failed_run_names_its_problems_and_starts_what_has_changed_alone(failed):
    assert "Traceback (most recent call last)" not in failed.output
    started = re.findall(r"^(?:local)?rule (\w+):", failed.output, re.MULTILINE)
    assert sorted(started) == ["fit_neuma", "fit_neuma", "gaussians"]


def test_a_damaged_image(failed):
    (error,) = re.findall(r"gaussians BouncyBall\+seed=1: ERROR.*", failed.output)
    assert "tiny/data/BouncyBall/static/s_003.png" in error and "gaussians.log" in error
    folder = failed.root / f"{SCENE}+seed=1"
    assert not (folder / "gaussians.ply").exists() and not list(folder.glob(".partial*"))


def test_a_checkpoint_of_other_settings(failed):
    path = f"{SCENE}/neuma+seed=7/checkpoint.pt"
    assert f"{path}: is the checkpoint of another run" in failed.output and f"rm '{path}'" in failed.output
    assert [f.name for f in (failed.root / path).parent.iterdir()] == ["checkpoint.pt"]


def test_results_that_a_failed_job_was_to_replace_count_as_out_of_date(failed, finished):
    """Its outputs are removed, and what was made of them with former settings is still there."""
    before = finished.artifacts()
    folder = failed.root / SCENE / "neuma"
    assert f"{SCENE}/neuma/checkpoint.pt: is not a valid checkpoint: cannot be read" in failed.output
    assert not (folder / "adaptor.safetensors").exists()
    (folder / "checkpoint.pt").unlink()
    assert failed.plan(TABLE) == {}, "with the former settings the table is unchanged"
    assert Plan.of(failed.run(*LONGER)) == {"fit_neuma": 1, "evaluate": 1, "chamfer_table": 1}
    after = failed.artifacts()
    changed = {name for name in before if before[name] != after[name]}
    assert {Path(name).name for name in changed} <= {
        *("adaptor.safetensors", "history.json", "rollout.h5", "metrics.json", "table1.csv", "table1.md")
    }
    assert f"{SCENE}/neuma/adaptor.safetensors" in changed
    assert failed.plan(*LONGER) == {}


# ---- killed and run again


def started_training(project: Project) -> tuple[subprocess.Popen, int]:
    """Start training, and wait until it has gone some way. Returns Snakemake and the number of the training process."""
    checkpoint = (project.root / full_run.LONG).with_name("checkpoint.pt")

    def written():
        return checkpoint.exists() and checkpoint.stat().st_mtime_ns

    before = written()
    snakemake = project.start(full_run.LONG)
    first = wait_for(lambda: (now := written()) != before and now)
    wait_for(lambda: written() > first)
    (training,) = project.processes("fit")
    return snakemake, training


def test_a_killed_training_and_a_killed_snakemake_resume_with_the_same_result(clone, full):
    make = ["make", "-o", "env", "unlock", f"VENV={sys.prefix}"]
    folder = (clone.root / full_run.LONG).parent
    snakemake, training = started_training(clone)
    os.kill(training, signal.SIGKILL)
    assert snakemake.wait(60) != 0
    assert {f.name for f in folder.iterdir()} - {".partial-checkpoint.pt"} == {"checkpoint.pt"}

    snakemake, training = started_training(clone)
    os.killpg(snakemake.pid, signal.SIGINT)  # as Ctrl-C does
    assert snakemake.wait(60) != 0 and not list(clone.root.glob(".snakemake/locks/*"))

    snakemake, training = started_training(clone)
    assert re.search(r"resumed at iteration \d+ of 600", (clone.root / "started.log").read_text())
    os.kill(training, signal.SIGSTOP)  # or it may end before Snakemake is killed
    busy = subprocess.run(make, cwd=clone.root, capture_output=True, text=True)
    assert busy.returncode != 0 and f"process {snakemake.pid}" in busy.stdout
    assert f"Another Snakemake is at work in this folder (process {snakemake.pid}" in clone.run(
        full_run.LONG, succeeds=False
    )
    os.kill(training, signal.SIGCONT)
    os.kill(snakemake.pid, signal.SIGKILL)
    snakemake.wait(60)
    # Its scripts do not go on alone.
    wait_for(lambda: not clone.processes("fit"), 20)
    assert "unlock" in clone.run(full_run.LONG, succeeds=False)
    wait_for(lambda: subprocess.run(make, cwd=clone.root, capture_output=True).returncode == 0, 20)

    assert re.search(r"resumed at iteration \d+ of 600", clone.run(full_run.LONG))
    assert not (folder / "checkpoint.pt").exists()
    assert not (full.root / full_run.LONG).with_name("checkpoint.pt").exists()
    assert (clone.root / full_run.LONG).read_bytes() == (full.root / full_run.LONG).read_bytes()
