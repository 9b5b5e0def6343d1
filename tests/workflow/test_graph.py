"""What rules read, over the graph of all jobs behind everything that can be asked for."""

import re

import pytest
from project import SCENE, copied

SUPERVISED = "neuma_particle_supervision"  # the one method that trains on the truth
# Blender films the truth, a dataset is packed of it, evaluation measures against it, and these figures show it.
MAY_READ_THE_TRUTH = {
    *("render_static", "render_dynamic", "pack", "initial_state", "evaluation", "experiment"),
    *("particles_app", "lora_alphav", "ext_time", "material_response"),
}


def jobs(plan: str) -> list[tuple[str, list[str], list[str]]]:
    """Rule, inputs and outputs of every job of a dry run."""
    found = []
    for rule, said in re.findall(r"^(?:local)?rule (\w+):\n((?:    .*\n)*)", plan, re.MULTILINE):
        listed = dict(re.findall(r"^    (input|output): (.*)$", said, re.MULTILINE))
        found.append((rule, *(listed.get(key, "").split(", ") for key in ("input", "output"))))
    return found


@pytest.fixture(scope="module")
def project(tmp_path_factory, kernels):
    return copied(tmp_path_factory.mktemp("graph"), kernels)


def test_only_evaluation_and_figures_of_it_and_one_ablation_read_the_truth(project):
    everything = ("tables", "figures", "videos", "packed", f"{SCENE}/{SUPERVISED}/image_metrics.json")
    graph = jobs(project.run("--dry-run", *everything))
    assert len(graph) > 80
    truths = {
        file for rule, _, made in graph if rule in ("ground_truth", "experiment_truth") for file in made
    }
    assert len(truths) > 5
    readers = {(rule, made[0]) for rule, read, made in graph if truths & set(read)}
    assert {rule for rule, _ in readers} == MAY_READ_THE_TRUTH | {"material"}
    trained = {made for rule, made in readers if rule == "material"}
    assert trained and all(f"/{SUPERVISED}" in made for made in trained)
    (supervised,) = [
        read for rule, read, made in graph if made[0] == f"{SCENE}/{SUPERVISED}/adaptor.safetensors"
    ]
    assert not any(file.endswith("transforms.json") for file in supervised)


def test_timings_read_the_benchmark_of_every_job_behind_them(project):
    graph = jobs(project.run("--dry-run", "tiny/results/timings.csv"))
    (read,) = [read for rule, read, _ in graph if rule == "timings"]
    assert len(read) == len(set(read)) == len(graph) - 1
    assert all(file.startswith("tiny/results/benchmarks/") for file in read)
