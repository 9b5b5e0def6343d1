"""A scene of several bodies: each reconstructed as a scene, all identified together, predicted without one of them."""

import pytest
import yaml

from tests.conftest import ROOT
from tests.support.project import copied, overlay

DATA, RESULTS = "tiny/data", "tiny/results"
PILE = yaml.safe_load((ROOT / "config" / "pile.yaml").read_text())["scenes"]["Pile"]
NAMES = list(PILE["bodies"])
WITHOUT = {"title": "without", "bodies": [{"scene": f"Pile_{name}"} for name in NAMES[1:]], "steps": 100}
CHANGES = overlay(
    scenes={"Pile": PILE | {"dt": 1e-3, "steps": 200}},
    experiments={"without": WITHOUT},
    identify={"refined_particles": 0},
    advanced={"figures.pile": "without"},
)


@pytest.fixture
def project(tmp_path, kernels):
    return copied(tmp_path / "project", kernels)


def test_bodies_are_scenes_that_are_identified_together(project):
    alone = [f"{RESULTS}/Pile_{name}/constants/metrics.json" for name in NAMES]
    plan = project.plan(
        *CHANGES,
        f"{RESULTS}/Pile/constants/metrics.json",
        f"{RESULTS}/Pile/true_law/metrics.json",
        f"{RESULTS}/experiments/without/constants/metrics.json",
        f"{RESULTS}/figures/pile.png",
        *alone,
    )
    counts = {"render_static": 1, "ground_truth": 2, "gaussians_of_bodies": 1, "velocity_of_bodies": 1}
    counts |= {
        rule: 3 for rule in ("body_static", "body_truth", "body_gaussians", "mesh", "binding", "identify")
    }
    counts |= {"identify_bodies": 1, "experiment_start": 2, "evaluate": 7, "pile": 1}
    assert {rule: plan[rule] for rule in counts} == counts and not plan["gaussians"]
    together = plan.one("identify_bodies")
    assert f"{DATA}/Pile/dynamic/transforms.json" in together.inputs
    assert {f"{RESULTS}/Pile_{name}/binding.h5" for name in NAMES} <= {*together.inputs}
    evaluated = {job.outputs[1]: {*job.inputs} for job in plan.of_rule("evaluate")}
    identified = f"{RESULTS}/Pile/identified.json"
    assert identified in evaluated[f"{RESULTS}/experiments/without/constants/metrics.json"]
    assert identified in evaluated[f"{RESULTS}/Pile/constants/metrics.json"]
    assert f"{RESULTS}/Pile/velocity.json" in evaluated[f"{RESULTS}/Pile/true_law/metrics.json"]
    for name, metrics in zip(NAMES, alone, strict=True):
        assert f"{RESULTS}/Pile_{name}/identified.json" in evaluated[metrics]
        assert identified not in evaluated[metrics]


def test_bodies_together_and_one_alone_share_the_cores(project):
    """The plan has two cores."""
    plan = project.plan(
        *CHANGES, *(f"{RESULTS}/{name}/identified.json" for name in ("Pile", f"Pile_{NAMES[0]}"))
    )
    assert all("threads: 2" not in plan.one(rule).text for rule in ("identify", "identify_bodies"))


def test_a_pile_has_no_fit_of_one_law(project):
    refused = project.run("--dry-run", *CHANGES, f"{RESULTS}/Pile/neuma/adaptor.safetensors", succeeds=False)
    assert "Pile_fish, Pile_duck, Pile_ball" in refused and "Traceback (most recent call last)" not in refused
