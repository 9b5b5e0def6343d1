"""The workflow as a user runs it: real Snakemake, every stage, on a setting of two minutes (tiny.yaml)."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from neuma_lib.evaluation.lpips import expected_shapes
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.weights import write_weights
from neuma_lib.paper.image_grid import load_image_grid
from tests.support.project import ROOT, SCENE, TABLE, Project, copied, wait_for

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
def test_every_stage_says_what_it_made_and_logs_it(finished, stage):
    said = re.findall(rf"^{stage} .*?: .*\d.*$", finished.output, re.MULTILINE)
    assert said
    log = next((finished.root / "tiny/results/logs").rglob(f"{stage}.log"))
    assert said[-1].split(": ", 1)[1] in log.read_text()


def test_same_seed_same_bytes_in_another_folder(finished, kernels, tmp_path):
    again = copied(tmp_path / "elsewhere", kernels, finished.root)
    again.run(TABLE, f"{SCENE}/initial_state.json", f"{SCENE}/neuma/video.mp4")
    first, second = finished.artifacts(), again.artifacts()
    assert first == second
    assert {Path(name).name for name in first} >= {
        *(
            "particles.h5",
            "sampled_particles.h5",
            "transforms.json",
            "gaussians.ply",
            "mesh.ply",
            "binding.h5",
            "velocity.json",
        ),
        *(
            "jelly.safetensors",
            "adaptor.safetensors",
            "rollout.h5",
            "metrics.json",
            "video.mp4",
            "table1.csv",
        ),
    }
    for name in first:
        assert str(finished.root).encode() not in (finished.root / name).read_bytes(), name


# ---- what runs again, and what does not


def test_nothing_to_do_when_nothing_changed(finished):
    assert finished.plan(TABLE) == {}


def test_compiled_kernels_rerun_nothing(finished, tmp_path):
    """A cache that others filled or emptied repeats no job."""
    variant = f"{SCENE}/neuma+rank=3/metrics.json"
    for cache in (), ("--config", f"kernel_cache={tmp_path}", "--"):
        assert finished.plan(*cache, TABLE) == {}
        assert finished.plan(*cache, variant) == {"fit_neuma": 1, "evaluate": 1}


def test_touching_reruns_nothing(clone):
    for folder in ("neuma_lib", "workflow", "config", "tests", "envs", "tiny"):
        for file in (clone.root / folder).rglob("*"):
            if file.is_file():
                os.utime(file)
    assert clone.plan(TABLE) == {}


def test_comments_and_docstrings_rerun_nothing(clone):
    for name in ("neuma_lib/splatting/rasterizer.py", "workflow/scripts/fit.py"):
        file = clone.root / name
        file.write_text(re.sub(r'^"""', '"""Reworded. ', file.read_text(), count=1) + "\n# a remark\n")
    assert clone.plan(TABLE) == {}


def test_a_training_parameter_reruns_training_and_evaluation_only(clone):
    change = ("--config", "training={iterations: 9}", "--")
    before = clone.artifacts()
    assert clone.plan(*change, TABLE) == {"fit_neuma": 1, "evaluate": 1, "chamfer_table": 1}
    clone.run(*change, TABLE)
    after = clone.artifacts()
    changed = {name for name in before if before[name] != after[name]}
    assert {Path(name).name for name in changed} <= {
        *("adaptor.safetensors", "history.json", "rollout.h5", "metrics.json", "table1.csv", "table1.md"),
    }
    assert f"{SCENE}/neuma/adaptor.safetensors" in changed
    assert clone.plan(*change, TABLE) == {}


def test_editing_the_rasterizer_reruns_what_renders(clone):
    file = clone.root / "neuma_lib" / "splatting" / "rasterizer.py"
    original = file.read_text()
    file.write_text(original + "\nEDITED = True\n")
    plan = clone.plan(TABLE)
    assert {
        "kernels",
        "gaussians",
        "mesh",
        "binding",
        "velocity",
        "fit_neuma",
        "evaluate",
        "chamfer_table",
    } <= set(plan)
    assert not {"ground_truth", "render_static", "render_dynamic", "prior"} & set(plan)
    assert plan["kernels"] == 1
    truth = clone.root / "tiny/data/BouncyBall/truth.h5"
    made = truth.stat().st_mtime_ns
    clone.run(f"{SCENE}/gaussians.ply")
    assert truth.stat().st_mtime_ns == made
    assert "gaussians" not in clone.plan(f"{SCENE}/gaussians.ply")


@pytest.mark.parametrize(
    ("file", "runs", "spared"),
    [
        (
            "neuma_lib/evaluation/motion.py",
            {"evaluate", "chamfer_table"},
            {"fit_neuma", "velocity", "ground_truth"},
        ),
        ("neuma_lib/paper/tables.py", {"chamfer_table"}, {"evaluate"}),
        (
            "neuma_lib/coupling/particle_binding.py",
            {"binding", "velocity", "fit_neuma", "evaluate"},
            {"gaussians", "mesh", "prior"},
        ),
        (
            "neuma_lib/data/blender/cycles.py",
            {"render_static", "render_dynamic", "gaussians"},
            {"ground_truth", "prior"},
        ),
        ("neuma_lib/sim/rollout.py", {"ground_truth", "prior", "fit_neuma"}, set()),
        ("neuma_lib/methods/neuma.py", {"fit_neuma", "evaluate"}, {"velocity", "ground_truth"}),
        ("neuma_lib/methods/spring_gaus/method.py", set(), {"fit_neuma", "evaluate"}),
        ("neuma_lib/methods/spring_gaus/fit.py", set(), {"fit_neuma", "evaluate"}),
        (
            "workflow/scripts/binding.py",
            {"binding", "velocity", "evaluate"},
            {"sampled_particles", "gaussians"},
        ),
    ],
)
def test_edits_rerun_what_depends_on_them(clone, file, runs, spared):
    path = clone.root / file
    path.write_text(path.read_text() + "\nEDITED = True\n")
    plan = set(clone.plan(TABLE))
    assert runs <= plan and not spared & plan


def test_a_variant_has_a_folder_of_its_own(finished):
    plan = finished.plan(f"{SCENE}/neuma+rank=2+seed=3/metrics.json")
    assert plan == {"fit_neuma": 1, "evaluate": 1}


# ---- learned laws elsewhere, and measures of images


def test_laws_are_put_to_use_on_other_bodies_and_images_are_measured(clone):
    """A letter above the reconstructed ball, both with the learned law; stand-in weights for LPIPS."""
    generator = torch.Generator().manual_seed(0)
    weights = {
        name: 0.1 * (torch.rand(shape, generator=generator) - 0.4)
        for net in ("alex", "vgg")
        for name, shape in expected_shapes(net).items()
    }
    write_weights(clone.root / "tiny/data/weights/lpips.safetensors", weights, {})
    targets = ("tiny/results/table2.csv", "tiny/results/table4.csv", f"{SCENE}/neuma/image_metrics.json")
    output = clone.run(*targets)
    assert re.search(r"^experiment_start letter_and_ball: 2 bodies, ", output, re.MULTILINE)
    assert clone.plan(*targets) == {}

    folder = clone.root / "tiny/results/experiments/letter_and_ball"
    letter, ball = json.loads((folder / "velocity.json").read_text())["bodies"]
    assert letter["v0"] == [0, -2, 0] and letter["angular_velocity"] == [0, 0, 0]
    estimate = json.loads((clone.root / SCENE / "velocity.json").read_text())
    assert all(ball[key] == estimate[key] for key in ("v0", "angular_velocity", "centre"))
    path, _ = read_arrays(folder / "nclaw" / "rollout.h5")
    assert path["x"].shape[1] == letter["particles"] + ball["particles"]
    split = letter["particles"]
    assert path["x"][0, :split, 1].min() > path["x"][0, split:, 1].max()
    # They meet: in free fall the letter would be below the floor.
    fallen = path["x"][0, :split, 1].mean() - path["x"][-1, :split, 1].mean()
    assert 0.05 < fallen < 0.45 < 2.0 * 0.18 + 0.5 * 9.8 * 0.18**2
    header, *rows = (clone.root / "tiny/results/table2.csv").read_text().splitlines()
    assert header.startswith("quantity,method,title,letter_and_ball,Average")
    assert rows[0].startswith("tracer_rmse_mm,nclaw,the prior,") and len(rows) == 11
    assert "BouncyBall" in (clone.root / "tiny/results/table4.csv").read_text()
    measured = json.loads((clone.root / SCENE / "neuma" / "image_metrics.json").read_text())
    assert measured["views"] == [1] and measured["views_seen_in_training"] == []
    assert len(measured["ssim_per_frame"]) == 7
    assert measured["psnr"] > 8 and measured["lpips_vgg"] != 0


def test_pac_nerf_is_judged_and_shown_on_its_own_particles(clone):
    """In so short a fit that nothing is found: what moves, carries tracers and is seen are the field's particles."""
    own = "pac_nerf_own+views=0,1"
    small = (
        'radiance={"iterations": 60}',
        'advanced={"radiance.rays": 256, "radiance.particles": 500, "pac_nerf.particles": 100, '
        '"pac_nerf.followed": 8, "pac_nerf.velocity_iterations": 3, "pac_nerf.iterations_contact": 1, '
        '"pac_nerf.iterations_all": 2, "pac_nerf.max_frames": 3, "pac_nerf.pixels": 200}',
        f'figures={{beside: ["{own}"]}}',
    )
    files = [f"{SCENE}/{own}/{name}" for name in ("metrics.json", "video.mp4")]
    targets = ("--config", *small, "--", *files, "tiny/results/figures/main_res.png")
    said = clone.run(*targets)
    assert clone.plan(*targets) == {}
    moving, shown = re.search(r"(\d+) of (\d+) particles simulated", said).groups()
    x = read_arrays(clone.root / SCENE / own / "rollout.h5", only=("x",))[0]["x"]
    shared = read_arrays(clone.root / SCENE / "neuma" / "rollout.h5", only=("x",))[0]["x"]
    assert x.shape == (7, int(moving), 3) and int(moving) < int(shown)
    assert abs(x[0].mean(0) - shared[0].mean(0)).max() < 0.03 and x.shape != shared.shape
    assert json.loads((clone.root / files[0]).read_text())["tracer_rmse_mm"] > 0
    grid = load_image_grid(clone.root / "tiny/results/figures/main_res.h5")
    assert grid.rows == ("Observation", "NCLaw", "NeuMA", "PAC-NeRF, own particles, views 0,1")
    seen, _, splatted, rendered = (row[0].astype(int) for row in grid.images)
    masks = [(image < 200).any(-1) for image in (seen, rendered)]
    assert (masks[0] & masks[1]).sum() > 0.5 * (masks[0] | masks[1]).sum()
    assert abs(rendered - splatted).max() > 20, "pictures of the field, not of Gaussians"


def test_a_chain_of_another_seed_draws_everything_anew(clone):
    before = clone.artifacts()
    clone.run("--config", "tables={table1: {seeds: 2}}", "--", TABLE)
    after = clone.artifacts()
    assert all(after[name] == digest for name, digest in before.items() if "table1" not in name)
    chains = {name: name.replace("BouncyBall/", "BouncyBall+seed=1/") for name in before if SCENE in name}
    chains["tiny/results/priors/jelly.safetensors"] = "tiny/results/priors/jelly+seed=1.safetensors"
    made = {name: other for name, other in chains.items() if other in after}
    assert {Path(name).name for name in made} >= {
        *("jelly.safetensors", "gaussians.ply", "mesh.ply", "particles.h5", "velocity.json"),
        *("adaptor.safetensors", "rollout.h5", "metrics.json"),
    }
    assert [name for name, other in made.items() if after[name] == after[other]] == []
    header, *rows = (clone.root / TABLE).read_text().splitlines()
    spreads = {row.split(",")[1] for row in rows if row.startswith("chamfer_std,")}
    assert spreads == {"nclaw", "neuma"}


def test_the_true_law_is_evaluated_without_training_or_prior(clone):
    target = f"{SCENE}/true_law/metrics.json"
    assert clone.plan(target) == {"evaluate": 1}
    assert "priors/" not in clone.run("--dry-run", target)
    clone.run(target)
    true, prior = (
        json.loads((clone.root / SCENE / m / "metrics.json").read_text()) for m in ("true_law", "nclaw")
    )
    assert 0 < true["tracer_rmse_mm"] < prior["tracer_rmse_mm"] and true["stable"]


def test_the_demo_leaves_something_to_look_at_and_a_law_that_a_scene_can_start_from(clone):
    output = clone.run("tiny/results/demo.md")
    assert "error of the motion: NCLaw" in output and f"{SCENE}/viewer.html" in output
    page = (clone.root / "tiny/results/demo.md").read_text()
    linked = {name for name in re.findall(r"BouncyBall/[\w./]+", page)}
    assert {Path(name).name for name in linked} == {
        "film.gif",
        "film.mp4",
        "law.safetensors",
        "law.png",
        "viewer.html",
    }
    for name in linked:
        assert (clone.root / "tiny/results" / name).stat().st_size > 1000, name
    law = f"{SCENE}/neuma/export/law.safetensors"
    changes = "scenes={BouncyBall: {prior: %s}}"
    variant = f"{SCENE}/neuma+iterations=1/adaptor.safetensors"
    shutil.copy(clone.root / law, clone.root / "law.safetensors")
    clone.run("--config", changes % "law.safetensors", "--", variant)
    # a law of networks at the step of another scene
    refused = clone.run(
        "--config", "scenes={BouncyBall: {prior: law.safetensors, dt: 1.0e-3}}", "--", variant, succeeds=False
    )
    assert "law.safetensors: dt: the law was trained at a time step of 0.002 s" in refused


def test_assumed_densities_are_runs_of_their_own(finished):
    plan = finished.plan(f"{SCENE}/neuma+assumed_density=900/metrics.json")
    assert plan == {"fit_neuma": 1, "evaluate": 1}


def test_all_tables_can_be_planned(finished):
    plan = finished.plan("tables")
    assert {"experiment_truth", "experiment_start", "evaluate_experiment", "benchmark_table"} <= set(plan)
    assert plan["chamfer_table"] >= 4 and plan["prior"] == 7


def test_all_figures_can_be_planned(finished):
    modules = (ROOT / "neuma_lib/paper/figures").glob("[!_]*.py")
    planned = finished.plan("--forceall", "figures", "random", "tiny/results/figures/realworld.png")
    # i23d needs a splat: test_splat_scenes.py makes it.
    assert {module.stem for module in modules} - {"i23d"} <= set(planned)


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_without_the_gpu_that_is_asked_for_nothing_is_begun(kernels, tmp_path):
    project = copied(tmp_path, kernels)
    adaptor = f"{SCENE}/neuma/adaptor.safetensors"
    cuda = ("--config", "device=cuda", "--")
    assert project.plan(*cuda, adaptor)["fit_neuma"] == 1
    output = project.run(*cuda, adaptor, succeeds=False)
    assert "torch sees no CUDA device" in output and "fit_neuma, gaussians, velocity" in output
    assert "Traceback (most recent call last)" not in output
    assert not (tmp_path / "tiny").exists()
    output = project.run(*cuda, "tiny/data/BouncyBall/truth.h5")
    assert "ground_truth BouncyBall: " in output


def test_what_a_failed_job_was_to_replace_counts_as_out_of_date(clone):
    """Its outputs are gone, and what was made of them with former settings is still there."""
    longer = ("--config", "training={iterations: 9}", "--", TABLE)
    damaged = clone.root / SCENE / "neuma" / "checkpoint.pt"
    damaged.write_text("damaged")
    assert "cannot be read" in clone.run(*longer, succeeds=False)
    assert not (clone.root / SCENE / "neuma" / "adaptor.safetensors").exists()
    damaged.unlink()
    assert clone.plan(*longer) == {"fit_neuma": 1, "evaluate": 1, "chamfer_table": 1}
    assert clone.plan(TABLE) == {}, "with the former settings the table is what it was"
    clone.run(*longer)
    assert clone.plan(*longer) == {}


# ---- killed and run again

LONG = "neuma+iterations=40+checkpoint_every=1"


@pytest.fixture(scope="module")
def uninterrupted(finished, tmp_path_factory):
    """The adaptor of a training that nobody disturbed."""
    project = finished.clone(tmp_path_factory.mktemp("uninterrupted") / "clone")
    project.run(f"{SCENE}/{LONG}/adaptor.safetensors")
    assert not (project.root / SCENE / LONG / "checkpoint.pt").exists()
    return (project.root / SCENE / LONG / "adaptor.safetensors").read_bytes()


def started_training(project: Project) -> tuple[subprocess.Popen, int]:
    """Start training, and wait until it has gone some way. Returns Snakemake and the number of the training process."""
    snakemake = project.start(f"{SCENE}/{LONG}/adaptor.safetensors")
    checkpoint = project.root / SCENE / LONG / "checkpoint.pt"
    first = wait_for(lambda: checkpoint.exists() and checkpoint.stat().st_mtime_ns)
    wait_for(lambda: checkpoint.stat().st_mtime_ns > first)
    (training,) = project.processes("fit")
    return snakemake, training


def resumed(project: Project) -> bytes:
    output = project.run(f"{SCENE}/{LONG}/adaptor.safetensors")
    assert re.search(r"resumed at iteration \d+ of 40", output)
    assert not (project.root / SCENE / LONG / "checkpoint.pt").exists()
    return (project.root / SCENE / LONG / "adaptor.safetensors").read_bytes()


def test_killed_training_resumes_with_the_same_result(clone, uninterrupted):
    snakemake, training = started_training(clone)
    os.kill(training, signal.SIGKILL)
    assert snakemake.wait(60) != 0
    left = {f.name for f in (clone.root / SCENE / LONG).iterdir()}
    assert left - {".partial-checkpoint.pt"} == {"checkpoint.pt"}
    assert resumed(clone) == uninterrupted


def test_killed_snakemake_resumes_with_the_same_result(clone, uninterrupted):
    make = ["make", "-o", "env", "unlock", f"VENV={sys.prefix}"]
    snakemake, training = started_training(clone)
    busy = subprocess.run(make, cwd=clone.root, capture_output=True, text=True)
    assert busy.returncode != 0 and "at work in this folder" in busy.stdout
    os.kill(snakemake.pid, signal.SIGKILL)
    snakemake.wait(60)
    # Its scripts do not go on alone.
    wait_for(lambda: not clone.processes("fit"), 20)
    assert "unlock" in clone.run(f"{SCENE}/{LONG}/adaptor.safetensors", succeeds=False)
    wait_for(lambda: subprocess.run(make, cwd=clone.root, capture_output=True).returncode == 0, 20)
    assert resumed(clone) == uninterrupted


# ---- bad input


def test_mistyped_key(finished):
    output = finished.run("--config", "training={iteratons: 3}", "--", TABLE, succeeds=False)
    assert "training.iteratons: unknown key; did you mean iterations" in output
    assert "Traceback (most recent call last)" not in output


@pytest.mark.parametrize(
    ("file", "message"),
    [
        (f"{SCENE}/neuma+rnk=3/metrics.json", "no option 'rnk'; did you mean rank"),
        (f"{SCENE}+sed=3/gaussians.ply", "no option 'sed'; did you mean seed"),
    ],
)
def test_mistyped_variant(finished, file, message):
    output = finished.run(file, succeeds=False)
    assert message in output
    assert "Traceback (most recent call last)" not in output


@pytest.mark.parametrize("damage", ["truncated", "missing", "no intrinsics"])
def test_damaged_images(clone, damage):
    folder = clone.root / "tiny/data/BouncyBall/static"
    file = folder / "s_003.png"
    if damage == "truncated":
        file.write_bytes(file.read_bytes()[:-100])
    elif damage == "missing":
        file.unlink()
    else:
        file = folder / "transforms.json"
        data = json.loads(file.read_text())
        for entry in (data, *data["frames"]):
            for key in ("fl_x", "fl_y", "camera_angle_x"):
                entry.pop(key, None)
        file.write_text(json.dumps(data))
    output = clone.run("--forcerun", "gaussians", "--", f"{SCENE}/gaussians.ply", succeeds=False)
    error = next(line for line in output.splitlines() if line.startswith("gaussians BouncyBall: ERROR"))
    assert str(file.relative_to(clone.root)) in error and "gaussians.log" in error
    assert "Traceback (most recent call last)" not in output
    assert not (clone.root / SCENE / "gaussians.ply").exists()
    assert not list((clone.root / SCENE).glob(".partial*"))


def test_checkpoint_of_other_settings(clone):
    path = f"{SCENE}/neuma+seed=7/checkpoint.pt"
    Checkpoint(clone.root / path, {"setting lr_elastic": "1.0"}).save(
        {"iteration": 1, "weights": torch.zeros(3)}
    )
    output = clone.run(f"{SCENE}/neuma+seed=7/adaptor.safetensors", succeeds=False)
    assert f"{path}: is the checkpoint of another run" in output and f"rm '{path}'" in output
    assert "Traceback (most recent call last)" not in output
    assert [f.name for f in (clone.root / path).parent.iterdir()] == ["checkpoint.pt"]
