"""A method and a law in files of the user, from the settings to a row of a table."""

import csv
import json

import pytest

from tests.support.project import SCENE, TABLE

LAW = '''
from neuma_lib.mechanics.catalogue import POISSON, YOUNG, Constant
from neuma_lib.mechanics.elasticity import AnalyticElasticity


class CubicHencky(AnalyticElasticity, name="cubic_hencky"):
    """tau_i = 2 mu eps_i (1 + b eps_i^2) + lam tr(eps)."""

    constants = {"E": YOUNG, "nu": POISSON, "b": Constant("1", 0.0)}

    def principal(self, sigma, mu, lam, b):
        eps = sigma.log()
        return 2 * mu * eps * (1 + b * eps**2) + lam * eps.sum(1, keepdim=True)
'''
METHOD = '''
"""A modulus from the mean brightness of the video: of no use, but short."""

from __future__ import annotations

from pydantic import Field

from neuma_lib.config.motion import MotionOptions
from neuma_lib.methods.base import Method, Preset


class BrightnessOptions(MotionOptions):
    scale: float = Field(1e5, gt=0, description="Young's modulus of a white video [Pa]")


class Brightness(Method):
    name = "brightness"
    Options = BrightnessOptions
    product = "modulus.json"
    fit_kernels = ()
    presets = {"brightness": Preset("Brightness", {"scale": 2e5}, note="One number.")}

    def fit_inputs(self, case):
        return {"transforms": case.data("dynamic/transforms.json")}

    def model_inputs(self, case):
        return {"modulus": case.product()}

    def fit(self, inputs, options, problem, run):
        from neuma_lib.io.files import write_json
        from neuma_lib.io.images import load_videos

        video, *_ = load_videos(inputs["transforms"], options["views"], **problem.exposure)
        modulus = options["scale"] * float(video.images.float().mean()) / 255
        write_json(run.product, {"E": modulus})
        write_json(run.history, {"scale": options["scale"]})
        run.log(f"E = {modulus:.4g} Pa")

    def load(self, inputs, options, dt):
        from neuma_lib.io.files import read_json
        from neuma_lib.mechanics.analytic import analytic_law
        from neuma_lib.methods.model import LawOnGrid

        modulus = read_json(inputs["modulus"])["E"]
        law = {"elasticity": {"name": "cubic_hencky", "E": modulus, "nu": 0.3, "b": 10.0}}
        return LawOnGrid(analytic_law(law, dt=dt))
'''
SETTINGS = (
    "--config",
    "extensions=[my_law.py, my_method.py]",
    'tables={"table1": {"methods": ["nclaw", "brightness", "brightness+scale=100000"]}}',
    "--",
)


@pytest.fixture(scope="module")
def project(finished, tmp_path_factory):
    """The finished copy with both files."""
    made = finished.clone(tmp_path_factory.mktemp("own") / "project")
    (made.root / "my_law.py").write_text(LAW)
    (made.root / "my_method.py").write_text(METHOD)
    return made


def test_a_method_in_a_file_gets_a_row_of_a_table(project):
    assert project.plan(*SETTINGS, TABLE) == {"fit_brightness": 2, "evaluate": 2, "chamfer_table": 1}
    output = project.run(*SETTINGS, TABLE)
    moduli = [
        json.loads((project.root / SCENE / name / "modulus.json").read_text())["E"]
        for name in ("brightness", "brightness+scale=100000")
    ]
    assert moduli[0] == pytest.approx(2 * moduli[1]) and f"E = {moduli[0]:.4g} Pa" in output
    rows = list(csv.reader((project.root / TABLE).read_text().splitlines()))
    errors = {row[1]: float(row[3]) for row in rows if row[0] == "tracer_rmse_mm"}
    assert [*errors] == ["nclaw", "brightness", "brightness+scale=100000"]
    assert errors["brightness"] != errors["brightness+scale=100000"]
    page = (project.root / "tiny/results/table1.md").read_text()
    assert "Brightness, scale 100000" in page and "One number." in page
    assert project.plan(*SETTINGS, TABLE) == {}
    assert project.plan(TABLE) == {"chamfer_table": 1}, "without it the table is as before"


@pytest.mark.parametrize(
    ("file", "old", "new", "expected"),
    [
        ("my_method.py", "/ 255", "/ 256", {"fit_brightness": 2, "evaluate": 2, "chamfer_table": 1}),
        ("my_method.py", "of no use", "useless", {}),
        ("my_law.py", "b * eps**2", "b * eps**4", {"fit_brightness": 2, "evaluate": 2, "chamfer_table": 1}),
    ],
)
def test_edits_of_the_files_repeat_what_depends_on_them(project, file, old, new, expected):
    path = project.root / file
    text = path.read_text()
    path.write_text(text.replace(old, new))
    assert project.plan(*SETTINGS, TABLE) == expected
    path.write_text(text)


def test_an_own_law_of_a_scene_repeats_that_scene_alone(project):
    law = {"elasticity": {"name": "cubic_hencky", "E": 1e5, "nu": 0.3, "b": 10.0}}
    scene = {"like": "BouncyBall", "law": law}
    settings = ("--config", "extensions=[my_law.py]", f"scenes={json.dumps({'Cubic': scene})}", "--")
    truths = [f"tiny/data/{name}/truth.h5" for name in ("BouncyBall", "Cubic")]
    assert project.plan(*settings, *truths) == {"ground_truth": 1}
    output = project.run(*settings, truths[1])
    assert "ground_truth Cubic: " in output and project.plan(*settings, *truths) == {}
    path = project.root / "my_law.py"
    path.write_text(LAW.replace("b * eps**2", "b * eps**4"))
    assert project.plan(*settings, *truths) == {"ground_truth": 1}
    path.write_text(LAW)


@pytest.mark.parametrize(
    ("extensions", "message"),
    [
        ("[no_such_file.py]", "extensions: no_such_file.py: the file does not exist"),
        ("3", "extensions: 3 is not"),
    ],
)
def test_extensions_with_mistakes_are_one_line(project, extensions, message):
    output = project.run("--config", f"extensions={extensions}", "--", TABLE, succeeds=False)
    assert message in output and "Traceback (most recent call last)" not in output
