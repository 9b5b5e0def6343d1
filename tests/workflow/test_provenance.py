"""The code digest changes when, and only when, something that a script reaches changes."""

import base64
import json
import os
from pathlib import Path

import pytest

from neuma_lib.mechanics.catalogue import DEFINED_IN
from neuma_lib.project import cases
from tests.support.project import SCENE, Plan, overlay
from workflow.provenance import Sources, fingerprint, law_files

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = ROOT / "workflow" / "scripts"
FILES = {
    "sample/__init__.py": "",
    "sample/render/__init__.py": "from sample.render.fast import draw\nfrom sample.render.cam import Cam\n",
    "sample/render/fast.py": "from . import kernels\ndef draw(): return kernels.k()\n",
    "sample/render/kernels.py": "def k(): return 1\n",
    "sample/render/kernels.cu": "__global__ void k() {}\n",
    "sample/render/cam.py": "class Cam: pass\n",
    "sample/other.py": "from sample.render.cam import Cam\n",
    "script.py": "from sample.render.fast import draw\nfrom sample.render import fast\n",
}


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A small package in the place of the library, and a script."""

    def write(name, text):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        os.utime(path, ns=(1, 1))  # times of files mean nothing

    for name, text in FILES.items():
        write(name, text)
    monkeypatch.syspath_prepend(tmp_path)
    write.script = tmp_path / "script.py"
    return write


def reached(project):
    return Sources("sample").reached(project.script)


def digest(project):
    return Sources("sample").digest(project.script)


def test_reaches_modules_through_packages_and_relative_imports(project):
    assert reached(project) == ["sample.render.fast", "sample.render.kernels"]


@pytest.mark.parametrize(
    "line", ["import sample.render", "from sample.render import draw", "def main(): import sample.render"]
)
def test_what_a_package_imports_itself_counts_where_it_is_used(project, line):
    project("script.py", line)
    assert reached(project) == [f"sample.render{end}" for end in ("", ".cam", ".fast", ".kernels")]


@pytest.mark.parametrize(
    ("file", "text", "changes"),
    [
        ("sample/render/kernels.py", "def k(): return 2\n", True),
        ("sample/render/kernels.py", '"""Documented."""\n\ndef k():\n    """One."""\n    return 1  # one\n', False),
        ("sample/render/kernels.cu", "__global__ void k() { return; }\n", True),
        ("sample/render/cam.py", "class Cam: x = 1\n", False),
        ("sample/render/__init__.py", "", False),
        ("sample/other.py", "x = 2\n", False),
        ("script.py", FILES["script.py"] + "# the end\n", False),
        ("script.py", FILES["script.py"] + "print(1)\n", True),
        ("script.py", FILES["script.py"] + "def main():\n    import sample.other\n", True),
    ],
)  # fmt: skip
def test_changes_that_count(project, file, text, changes):
    before = digest(project)
    project(file, text)
    assert (digest(project) != before) == changes


class TestThisProject:
    def reached(self, script, *modules):
        return set(Sources().reached(SCRIPTS / f"{script}.py", modules))

    @pytest.mark.parametrize("script", ["gaussians", "velocity", "video"])
    def test_what_renders_depends_on_the_rasterizer(self, script):
        assert "neuma_lib.splatting.rasterizer" in self.reached(script)

    def test_a_fit_depends_on_its_own_method_alone(self):
        springs = "neuma_lib.methods.spring_gaus.method"
        assert springs not in self.reached("fit", "neuma_lib.methods.neuma")
        assert "neuma_lib.fitting.material" in self.reached("fit", "neuma_lib.methods.neuma")
        assert "neuma_lib.splatting.rasterizer" in self.reached("fit", springs)
        assert "neuma_lib.fitting.material" not in self.reached("evaluate", "neuma_lib.methods.true_law")

    @pytest.mark.parametrize("method", ["neuma", "structured", "spring_gaus.method", "pac_nerf.method"])
    def test_fits_are_free_of_measures(self, method):
        reached = self.reached("fit", f"neuma_lib.methods.{method}")
        rooms = ("evaluation", "paper", "project", "viewer")
        assert not [name for name in reached if name.split(".")[1] in rooms]

    @pytest.mark.parametrize(
        "script", ["ground_truth", "prior", "sampled_particles", "render", "chamfer_table"]
    )
    def test_what_does_not_render_is_free_of_it(self, script):
        assert "neuma_lib.splatting.rasterizer" not in self.reached(script)

    @pytest.mark.parametrize("script", ["gaussians", "mesh", "binding", "velocity", "fit"])
    def test_no_stage_can_reach_the_truth(self, script):
        reached = self.reached(script, *(["neuma_lib.methods.structured"] if script == "fit" else []))
        assert "neuma_lib.data.ground_truth" not in reached and "neuma_lib.geometry.shapes" not in reached


@pytest.fixture(scope="module")
def jobs_with_code(finished, loaded):
    """Jobs of Table 1 in their order, with the names of the files whose edits rerun them.

    The digest of these files is the one that Snakemake has recorded of the job.
    """
    sources, jobs = Sources(), []
    for job in Plan.of(finished.output).jobs:
        wildcards = dict(word.split("=", 1) for word in job.listed("wildcards"))
        folder, name = ("kernels", wildcards["group"]) if job.rule == "kernels" else ("scripts", job.rule)
        shared = [script for script in ("fit", "render") if name.startswith(f"{script}_")]
        script = Path("workflow", folder, f"{(shared or [name])[0]}.py")
        method = wildcards.get("method")
        modules = (type(cases.kind_of(loaded, method)).__module__,) if method else ()
        record = base64.urlsafe_b64encode(job.outputs[0].encode()).decode()
        recorded = json.loads((finished.root / ".snakemake/metadata" / record).read_text())["params"]
        assert repr(sources.digest(ROOT / script, modules)) in recorded, job.rule
        reached = (f"{module.replace('.', '/')}.py" for module in sources.reached(ROOT / script, modules))
        jobs.append((job, {str(script), *reached}))
    return jobs


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
        (
            "neuma_lib/splatting/rasterizer.py",
            {"kernels", "gaussians", "mesh", "binding", "velocity", "fit_neuma", "evaluate", "chamfer_table"},
            {"ground_truth", "render_static", "render_dynamic", "prior"},
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
def test_edits_rerun_what_depends_on_them(jobs_with_code, file, runs, spared):
    """An edited file, and what reads the outputs of the jobs that it reruns."""
    assert (ROOT / file).is_file()
    rerun, replaced = set(), set()
    for job, files in jobs_with_code:
        if file in files or replaced & set(job.inputs):
            rerun.add(job.rule)
            replaced |= set(job.outputs)
    assert runs <= rerun and not spared & rerun


TRUE_NU = "'nu': 0.45"  # in the true law of the scene, and in no other setting of these jobs


def test_only_jobs_that_make_or_measure_the_truth_are_given_the_true_law(clone):
    """Parameters of Table 1, and of an identification, whose file is touched instead of computed."""
    target = f"{SCENE}/identified.json"
    (clone.root / target).write_text("{}")
    clone.run("--touch", "--forcerun", "identify", *overlay(identify={"refined_particles": 0}), target)
    given = {}
    for record in (clone.root / ".snakemake/metadata").iterdir():
        content = json.loads(record.read_text())
        given.setdefault(content["rule"], []).append(TRUE_NU in str(content["params"]))
    assert {rule for rule, has in given.items() if any(has)} == {"ground_truth"}
    assert {"identify", "fit_neuma", "prior", "velocity", "evaluate"} <= given.keys()


def test_a_method_in_a_file_counts_with_what_it_imports(tmp_path):
    file, script = tmp_path / "mine.py", SCRIPTS / "evaluate.py"
    springs = "neuma_lib.methods.spring_gaus.fit"
    digests = []
    for text in ("x = 1\n", "x = 1  # one\n", "x = 2\n"):
        file.write_text(text)
        digests.append(Sources().digest(script, (str(file),)))
    assert digests[0] == digests[1] != digests[2]
    assert springs not in Sources().reached(script, (str(file),))
    file.write_text(f"import {springs}\n")
    assert springs in Sources().reached(script, (str(file),))


def test_own_laws_are_noticed_in_parameters(monkeypatch):
    monkeypatch.setitem(DEFINED_IN, ("elasticity", "mine"), "mine.py")
    assert law_files([{"law": {"elasticity": {"name": "mine", "E": 1.0}}}, 3]) == {"mine.py"}
    assert law_files({"laws": [{"elasticity": {"name": "hencky"}}], "title": "mine"}) == set()


def test_fingerprint_names_what_changed(tmp_path):
    (tmp_path / "input").write_text("a")
    first = fingerprint({"lr": 0.1, "big": list(range(100))}, {"video": tmp_path / "input"}, "c0de")
    (tmp_path / "input").write_text("b")
    second = fingerprint({"lr": 0.2, "big": list(range(100))}, {"video": tmp_path / "input"}, "c0de")
    assert {k for k in first if first[k] != second[k]} == {"setting lr", "input video"}
    assert all(len(v) <= 40 for v in first.values())
