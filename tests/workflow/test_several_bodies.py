"""A scene of several bodies: each reconstructed as a scene, all identified together, predicted without one of them."""

import numpy as np
import pytest
import yaml

from neuma_lib.geometry.shapes import place
from neuma_lib.geometry.volume import signed_distance
from neuma_lib.io.files import read_json
from neuma_lib.io.gaussians import load_gaussians
from neuma_lib.io.mesh import read_mesh
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
    for method, file in (("neuma", "adaptor.safetensors"), ("neuma_structured", "image_metrics.json")):
        target = f"{RESULTS}/Pile/{method}/{file}"
        refused = project.run("--dry-run", *CHANGES, target, succeeds=False)
        assert (
            "Pile_fish, Pile_duck, Pile_ball" in refused
            and "Traceback (most recent call last)" not in refused
        )


def test_laws_are_corrected_in_the_video_of_all(project):
    """In the fit and in predictions: of all, without one, and of one alone, which has its own."""
    method = "neuma_structured"
    plan = project.plan(
        *CHANGES,
        f"{RESULTS}/Pile/{method}/metrics.json",
        f"{RESULTS}/experiments/without/{method}/metrics.json",
        f"{RESULTS}/Pile_duck/{method}/metrics.json",
    )
    fits = {job.outputs[0]: {*job.inputs} for job in plan.of_rule("fit_structured")}
    product, alone = (f"{RESULTS}/{scene}/{method}/adaptor.safetensors" for scene in ("Pile", "Pile_duck"))
    identified = f"{RESULTS}/Pile/identified.json"
    assert set(fits) == {product, alone}
    particles = {f"{RESULTS}/Pile_{name}/particles.h5" for name in NAMES}
    assert {f"{DATA}/Pile/dynamic/transforms.json", identified, *particles} <= fits[product]
    assert particles & fits[alone] == {f"{RESULTS}/Pile_duck/particles.h5"} and identified not in fits[alone]
    evaluated = {job.outputs[1]: {*job.inputs} for job in plan.of_rule("evaluate")}
    for column, file in (("Pile", product), ("experiments/without", product), ("Pile_duck", alone)):
        inputs = evaluated[f"{RESULTS}/{column}/{method}/metrics.json"]
        assert {product, alone} & inputs == {file} and (identified in inputs) == (file == product)
    target = f"{RESULTS}/Pile/{method}+prior=jelly/adaptor.safetensors"
    assert "Use +prior=identified" in project.run("--dry-run", *CHANGES, target, succeeds=False)


def test_a_pile_takes_the_law_of_another_scene(project):
    method = "constants+law_from=BouncyBall"
    plan = project.plan(*CHANGES, f"{RESULTS}/Pile/{method}/metrics.json")
    assert f"{RESULTS}/BouncyBall/identified.json" in plan.one("evaluate").inputs


TOUCHING = {"duck": {"height": 0.4265}, "ball": {"height": 0.4265, "center": [0.6745, 0.5]}}
"""Duck on the fish, and ball at the duck, 0.2 mm apart."""


@pytest.mark.slow
def test_bodies_that_touch_at_the_start(project):
    """In the static pictures and in the first frame. The ball presses on the duck."""
    bodies = {name: body | TOUCHING.get(name, {}) for name, body in PILE["bodies"].items()}
    bodies["ball"]["velocity"] = [-0.6, -0.3, 0.0]
    pile = PILE | {"bodies": bodies, "dt": 5e-4, "steps": 600}
    families = {"fish": "drucker_prager", "duck": "fixed_corotated", "ball": "neo_hookean"}
    changes = overlay(
        scenes={"Pile": pile},
        dataset={
            "static": {"views": 24, "width": 96, "height": 96, "samples": 8},
            "dynamic": {"views": 1, "width": 64, "height": 64, "samples": 8},
        },
        gaussians={"iterations": 400, "initial_count": 1000, "hull_resolution": 48},
        geometry={"particles": 600, "surface": {"resolution": 48}},
        simulation={"grid": 24},
        advanced={f"scenes.Pile.bodies.{name}.family": family for name, family in families.items()},
    )
    corrected = "neuma_structured+iterations=2+trial_iterations=2"
    methods = ("constants", "true_law", corrected)
    runs = [project.root / RESULTS / "Pile" / method / "metrics.json" for method in methods]
    project.run(*changes, *(str(file.relative_to(project.root)) for file in runs))
    results = project.root / RESULTS
    solids = [
        place(body["shape"], body["size"], body["height"], body.get("center", (0.5, 0.5)))
        for body in bodies.values()
    ]
    count = wrong = 0
    for k, (name, solid) in enumerate(zip(bodies, solids, strict=True)):
        means = load_gaussians(results / f"Pile_{name}/gaussians.ply").means.numpy().astype(float)
        nearest = np.argmin([signed_distance(each, means) for each in solids], axis=0)
        count, wrong = count + len(means), wrong + int((nearest != k).sum())
        if name != "fish":  # whose fins are thinner than a pixel
            assert read_mesh(results / f"Pile_{name}/mesh.ply").volume == pytest.approx(
                solid.volume, rel=0.03
            )
    assert count == len(load_gaussians(results / "Pile/whole.ply").means) and wrong < 0.005 * count
    errors = [[body["tracer_rmse_mm"] for body in read_json(file)["bodies"]] for file in runs]
    identified, true, after = map(np.array, errors)
    assert identified.mean() < 1.5 * true.mean() and after.mean() < 1.1 * identified.mean()
    history = read_json(results / "Pile" / corrected / "history.json")
    assert set(history["trials"]) >= {"nothing", *(f"{name}: elastic" for name in bodies)}
    if history["corrected_parts"]:
        assert history["name"] in bodies and not np.allclose(after, identified, rtol=1e-3)
    else:
        np.testing.assert_allclose(after, identified, rtol=1e-3, err_msg="the identified laws remain")
    pairs = {frozenset(pair["bodies"]): pair for pair in read_json(results / "Pile/identified.json")["pairs"]}
    pressed = pairs[frozenset(("duck", "ball"))]
    assert abs(np.log(pressed["friction"] / 0.3)) < 3 * pressed["log_std"] < 1.5
