"""The workflow through a real SLURM on this machine: profiles/slurm, as a user of a cluster runs it.

One host, no cgroups, no accounting database and no GPU: what a second host, a filesystem between hosts and a real GPU
would change is not tested. These tests check the table, what a SLURM job requests, and how it ends.
"""

import re
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch

from neuma_lib.io.weights import read_torch
from neuma_lib.project.timings import used
from tests.support.project import SCENE, TABLE, Project, copied, wait_for

# Table 1 with a training that is long enough to be cancelled in the middle; all before it is there.
LONGER = ("--config", "training={iterations: 400}", "--", TABLE)
CHECKPOINT = f"{SCENE}/neuma/checkpoint.pt"
SCENE_RULES = (
    *("ground_truth", "render_static", "render_dynamic", "gaussians", "mesh", "sampled_particles"),
    *("binding", "velocity", "tracers", "fit_neuma", "evaluate"),
)


def jobs(slurm) -> dict[str, dict[str, str]]:
    """All jobs that SLURM remembers, the last first: number, and the fields of ``scontrol show job``."""
    lines = [
        line for line in slurm.ask("scontrol", "-o", "show", "job").splitlines() if line.startswith("JobId=")
    ]
    fields = [dict(re.findall(r"(\S+?)=(\S*)", line)) for line in lines]
    return {job["JobId"]: job for job in sorted(fields, key=lambda job: -int(job["JobId"]))}


def job_of(slurm, rule: str) -> dict[str, str]:
    """The last job of a rule."""
    return next(job for job in jobs(slurm).values() if job["Comment"].startswith(f"rule_{rule}"))


def submitted(output: str) -> list[str]:
    """Numbers of the jobs that a run of Snakemake has submitted."""
    return re.findall(r"has been submitted with SLURM jobid (\d+)", output)


def seconds(clock: str) -> int:
    """SLURM's ``[days-]hours:minutes:seconds``."""
    days, _, rest = clock.rpartition("-")
    hours, minutes, rest = map(int, rest.split(":"))
    return ((int(days or 0) * 24 + hours) * 60 + minutes) * 60 + rest


def comment(rule: str, wildcards: Sequence[str]) -> str:
    """Name that the plugin gives to a job of SLURM, in addition to its number."""
    return "_".join([f"rule_{rule}", *(["wildcards", *wildcards] if wildcards else [])])


def requested_by_rules(project: Project) -> dict[str, dict[str, int]]:
    """Resources of all jobs behind the table, by their comment, as Snakemake plans them without SLURM."""
    results = {}
    for block in re.split(
        r"^\[", Project(project.root).run("--dry-run", "--forceall", TABLE), flags=re.MULTILINE
    ):
        if rule := re.search(r"^rule (\w+):", block, re.MULTILINE):
            lines = dict(re.findall(r"^ +(wildcards|resources): (.*)$", block, re.MULTILINE))
            wildcards = re.findall(r"\w+=([^,]+)", lines.get("wildcards", ""))
            resources = re.findall(r"(gpu|mem_mb|runtime)=(\d+)", lines["resources"])
            results[comment(rule[1], wildcards)] = {name: int(value) for name, value in resources}
    return results


def measured(project: Project) -> dict[str, dict[str, float]]:
    """Benchmarks of a run: the comment that the job of each has, and its seconds and MB."""
    results = {}
    for folder in (project.root / "tiny/results/benchmarks", project.root / "tiny/data/kernels/benchmarks"):
        for file in folder.rglob("*.tsv"):
            *wildcards, rule = file.relative_to(folder).with_suffix("").parts
            names, values, *_ = (line.split("\t") for line in file.read_text().splitlines())
            row = dict(zip(names, values))
            results[comment(rule, wildcards)] = {name: float(row[name]) for name in ("s", "max_rss")}
    return results


def slurm_log(job: dict[str, str]) -> str:
    return Path(job["StdOut"]).read_text()


# ---- from nothing to a table


def test_nothing_is_left_to_do_with_or_without_slurm(finished):
    """What the nodes recorded of settings, inputs and code is what this machine would have recorded."""
    assert finished.plan(TABLE) == {}
    assert Project(finished.root).plan(TABLE) == {}


def test_every_job_ends_well_and_its_log_arrives(finished, slurm):
    ran = set(submitted(finished.output))
    states = {job["JobId"]: job["JobState"] for job in slurm.completed()}
    assert len(ran) == len(measured(finished)) >= 18
    assert {states[number] for number in ran} == {"COMPLETED"}
    logs = [*(finished.root / "tiny").rglob("*.log")]
    assert len(logs) == len(ran)
    for log in logs:
        assert used(log), log
    # SLURM's own logs of jobs that ended well are removed by the plugin.
    assert not [*(finished.root / ".snakemake/slurm_logs").rglob("*.log")]


def test_jobs_ask_for_what_their_rules_state_and_use_no_more(finished, slurm):
    """Memory beyond what was asked for would have ended a job: SLURM samples all its processes every second."""
    planned = requested_by_rules(finished)
    ran = set(submitted(finished.output))
    asked = {job["Comment"]: job for number, job in jobs(slurm).items() if number in ran}
    used = measured(finished)
    assert set(planned) == set(asked) == set(used)
    assert planned[f"rule_fit_neuma_wildcards_{Path(SCENE).name}_neuma"]["mem_mb"] == 6000
    for name, job in asked.items():
        requested = planned[name]
        assert f"cpu=1,mem={requested['mem_mb']}M,node=1," in job["TRES"], name
        assert seconds(job["TimeLimit"]) == 60 * requested["runtime"], name
        assert requested["gpu"] == 0 and "TresPerJob" not in job, name
        assert used[name]["max_rss"] < requested["mem_mb"], name
        assert used[name]["s"] <= seconds(job["RunTime"]) < seconds(job["TimeLimit"]), name


# ---- stopped in the middle


@pytest.fixture(scope="module")
def uninterrupted(finished, tmp_path_factory):
    """The artifacts of a run that nobody disturbed, made without SLURM."""
    root = tmp_path_factory.mktemp("uninterrupted") / "clone"
    project = Project(finished.clone(root).root, seconds=finished.seconds)
    project.run(*LONGER)
    return project.artifacts()


@pytest.fixture
def interruptible():
    """Ctrl-C reaches processes that are started here, even if this one ignores it (``nohup``, ``&``)."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def reached(project: Project) -> int:
    """The iteration of the checkpoint; 0 where there is none."""
    file = project.root / CHECKPOINT
    return read_torch(file)["state"]["iteration"] if file.exists() else 0


def started_training(project: Project, slurm) -> tuple[subprocess.Popen, dict[str, str]]:
    """Start the run, and wait until its training has gone some way. Returns Snakemake and SLURM's job."""
    snakemake = project.start(*LONGER)
    wait_for(lambda: reached(project) >= 20, 600)
    job = job_of(slurm, "fit_neuma")
    assert job["JobState"] == "RUNNING"
    return snakemake, job


def goes_on(project: Project, slurm, uninterrupted: dict[str, str]) -> None:
    """The same command again: finished files are kept, and the results are the same."""
    iteration, finished = reached(project), made(project)
    assert 20 <= iteration < 400
    output = project.run(*LONGER)
    listed = jobs(slurm)
    names = {listed[number]["Comment"].split("_wildcards_")[0] for number in submitted(output)}
    assert names == {"rule_fit_neuma", "rule_evaluate", "rule_chamfer_table"}
    assert len(submitted(output)) == 3
    (log,) = (project.root / "tiny/results/logs").rglob("neuma/fit_neuma.log")
    assert f"resumed at iteration {iteration} of 400" in log.read_text()
    assert project.artifacts() == uninterrupted
    remade = {name for name, time in made(project).items() if finished.get(name) != time}
    assert remade == {
        *(f"{SCENE}/neuma/{file}" for file in ("adaptor.safetensors", "history.json")),
        *(f"{SCENE}/neuma/{file}" for file in ("rollout.h5", "metrics.json")),
        *(str(Path(TABLE).with_suffix(end)) for end in (".csv", ".md")),
    }


def made(project: Project) -> dict[str, int]:
    """When each artifact was written [ns]."""
    return {name: (project.root / name).stat().st_mtime_ns for name in project.artifacts()}


def test_a_cancelled_job_goes_on_by_the_same_command(clone, slurm, uninterrupted):
    snakemake, job = started_training(clone, slurm)
    slurm.ask("scancel", job["JobId"])
    assert snakemake.wait(300) != 0
    log = (clone.root / "started.log").read_text()
    assert f"SLURM-job '{job['JobId']}' failed, SLURM status is: 'CANCELLED'" in log
    assert job["StdOut"] in log and "CANCELLED" in slurm_log(job)
    goes_on(clone, slurm, uninterrupted)


def test_an_interrupted_snakemake_takes_its_jobs_along(interruptible, clone, slurm, uninterrupted):
    snakemake, job = started_training(clone, slurm)
    snakemake.send_signal(signal.SIGINT)
    assert snakemake.wait(300) != 0
    wait_for(lambda: jobs(slurm)[job["JobId"]]["JobState"] == "CANCELLED", 60)
    goes_on(clone, slurm, uninterrupted)


def test_a_job_that_needs_more_memory_than_it_asks_for_is_ended_with_a_message(clone, slurm):
    target = f"{SCENE}/neuma+rank=3/adaptor.safetensors"
    clone.run("--set-resources", "fit_neuma:mem_mb=300", "--", target, succeeds=False)
    job = job_of(slurm, "fit_neuma")
    assert "mem=300M" in job["TRES"] and job["JobState"] == "FAILED"
    assert "Exceeded job memory limit" in slurm_log(job)
    assert not (clone.root / target).exists()
    clone.run(target)
    assert "mem=6000M" in job_of(slurm, "fit_neuma")["TRES"]


# ---- several of ours as one of SLURM's


def test_all_of_a_scene_may_be_one_job(clone, slurm):
    """``--groups``: one job asks for what its rules take side by side, and for the minutes of one after the other."""
    before, times = clone.artifacts(), made(clone)
    groups = [f"{rule}=scene" for rule in SCENE_RULES]
    output = clone.run("--forcerun", "ground_truth", "--groups", *groups, "--", TABLE)
    scene, table = (jobs(slurm)[number] for number in submitted(output))
    assert scene["JobState"] == table["JobState"] == "COMPLETED"
    assert table["Comment"].startswith("rule_chamfer_table")
    # NeuMA's training next to the evaluation of the prior; and nine stages, of which training takes up to four hours.
    assert "cpu=2,mem=10000M,node=1," in scene["TRES"]
    assert seconds(scene["TimeLimit"]) == 60 * (8 * 60 + 240)
    assert clone.artifacts() == before
    kept = {name for name, time in made(clone).items() if times[name] == time}
    assert kept and all("/kernels/" in name or "/priors/" in name for name in kept)
    assert all(used(log) for log in (clone.root / "tiny").rglob("*.log"))


# ---- GPUs


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_a_job_asks_for_a_gpu_where_the_settings_do_and_reports_that_it_sees_none(clone, slurm):
    """SLURM hands out a GPU in name: tested are that a job waits for one, and its message without."""
    clone.run("--config", "device=cuda", "--", f"{SCENE}/gaussians.ply", succeeds=False)
    job = job_of(slurm, "gaussians")
    assert job["TresPerJob"] == "gres:gpu:1" and job["JobState"] == "FAILED"
    assert "torch sees no CUDA device" in slurm_log(job)


# ---- compared with a run without SLURM


def test_the_table_and_all_before_it_are_those_of_a_run_without_slurm(finished, kernels, tmp_path):
    local = copied(tmp_path / "local", kernels)
    local.seconds = finished.seconds
    local.run(TABLE)
    assert f"{SCENE}/neuma/metrics.json" in local.artifacts() and TABLE in local.artifacts()
    assert finished.artifacts() == local.artifacts()
