"""Models of every method from small files, several bodies in one model, draws, and where methods come from."""

import math
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from neuma_lib.io.exported import about_law
from neuma_lib.io.files import write_json
from neuma_lib.io.hdf5 import write_arrays
from neuma_lib.io.laws import load_law, save_adaptor, save_law, save_prior
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.mechanics.structured import structured_law
from neuma_lib.methods import registry
from neuma_lib.methods.base import ModelSource, Problem, method_of
from neuma_lib.methods.model import LawOnGrid
from neuma_lib.methods.prior import prior_source
from neuma_lib.methods.structured import Structured, StructuredOptions
from neuma_lib.project import cases
from neuma_lib.sim.model import MPM, consecutive
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.errors import refused
from tests.support.grounding_scene import ball, observe

ROOT = Path(__file__).resolve().parents[2]
DT = 1e-3
SPEC = {
    "elasticity": {"name": "hencky", "E": 1e5, "nu": 0.3},
    "plasticity": {"name": "von_mises", "yield_stress": 2e3},
}
STIFF = {"elasticity": {"name": "neo_hookean", "E": 3e5, "nu": 0.2}}
COVARIANCE = [[0.01, 0.0, 0.0], [0.0, 0.02, 0.0], [0.0, 0.0, 0.03]]


def cube(side=0.1, count=5, height=0.3):
    ticks = (torch.arange(count) + 0.5) / count * side - side / 2
    x = torch.cartesian_prod(ticks, ticks, ticks) + torch.tensor([0.5, height, 0.5])
    vol0 = torch.full((len(x),), side**3 / len(x))
    return State(x, torch.tensor([0.0, -2.0, 0.0]).expand_as(x), 1000 * vol0, vol0)


def bent(law):
    """Stress and returned deformation of a law in a few states."""
    F = torch.randn(20, 3, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    F, law = torch.eye(3) + 0.1 * F, law.to(torch.float64)
    with torch.no_grad():
        return torch.stack([law.elasticity(F), law.plasticity(F)])


def loaded(module, files, options=None):
    return ModelSource(f"neuma_lib.methods.{module}", options or {}, files, DT).load()


def trained(law):
    """A law with an adaptor of rank 2 whose weights are not zero."""
    law.attach_adaptor(2, 4.0, 0)
    with torch.no_grad():
        for part in law.parts.values():
            for weight in part.adaptor.parameters():
                weight.add_(0.1 * torch.randn(weight.shape, generator=torch.Generator().manual_seed(1)))
    return law


def identified(path, spec=SPEC, **extra):
    fit = {"law": spec, "unbounded": {"values": [11.5, -0.4, 7.6], "covariance": COVARIANCE}}
    write_json(path, {"law": spec, "best": fit, "families": {}, "ties": [], **extra})
    return str(path)


# ---- loading


def test_a_prior_is_the_law_of_its_file(tmp_path):
    path = str(tmp_path / "prior.safetensors")
    save_prior(path, neural_law(seed=0), {})
    model = prior_source(path, DT).load()
    assert torch.equal(bent(model.law), bent(load_law(path))) and model.stable


def test_an_analytic_law_in_a_file_is_a_prior(tmp_path):
    path = str(tmp_path / "law.safetensors")
    save_law(path, analytic_law(SPEC), about_law(analytic_law(SPEC), None))
    assert torch.equal(bent(prior_source(path, DT).load().law), bent(analytic_law(SPEC)))


@pytest.mark.parametrize("stable", [True, False])
def test_neuma_is_a_prior_with_an_adaptor(tmp_path, stable):
    law = neural_law(seed=0)
    files = {name: str(tmp_path / f"{name}.safetensors") for name in ("prior", "adaptor")}
    save_prior(files["prior"], law, {})
    save_adaptor(files["adaptor"], trained(law), 2, 4.0, {"stable": stable})
    model = loaded("neuma", files)
    assert torch.equal(bent(model.law), bent(law)) and model.stable is stable
    assert not torch.equal(bent(model.law), bent(load_law(files["prior"])))


def test_neuma_may_have_the_inputs_of_the_constants(changed):
    """All rows that start as identified have the same options of motion. NeuMA's training is otherwise the same."""
    settings = changed()
    shared = ("covariance_from", "gaussian_motion", "start", "views", "particle_source", "assumed_density")

    def options(name):
        return cases.case(settings, "ClayCat", name).options.plain()

    constants, plain, same = map(options, ("constants", "neuma", "neuma_same_inputs"))
    assert {key: same[key] for key in shared} == {key: constants[key] for key in shared}
    assert {key for key in same if same[key] != plain[key]} == {"covariance_from", "gaussian_motion", "start"}
    assert all(options("neuma_structured")[key] == constants[key] for key in shared)
    case = cases.case(settings, "ClayCat", "neuma_same_inputs")
    assert case.method.fit_inputs(case)["velocity"] == case.result("identified.json")
    assert case.method.start_file(case) == case.result("identified.json")


def test_a_structured_law_is_complete_in_its_file(tmp_path):
    law = structured_law({**SPEC, "form": "stretch"}, DT, seed=0)
    path = str(tmp_path / "adaptor.safetensors")
    save_adaptor(path, trained(law), 2, 4.0, {"stable": True})
    model = loaded("structured", {"adaptor": path})
    assert torch.equal(bent(model.law), bent(law)) and model.law.elasticity.form == "stretch"


def test_constants_are_those_identified(tmp_path):
    model = loaded("constants", {"identified": identified(tmp_path / "identified.json")})
    assert torch.equal(bent(model.law), bent(analytic_law(SPEC)))


@pytest.mark.parametrize(("record", "friction"), [({"value": 0.4}, 0.4), ({"at_least": 0.8}, math.inf)])
@pytest.mark.parametrize("name", ["constants", "structured"])
def test_identified_friction_moves_the_body(name, record, friction, tmp_path):
    """The motion of the simulator with this coefficient for all obstacles. In another scene, a floor with a coefficient
    keeps it."""
    mpm = MPM(grid=16, dt=DT, contact="particles", boundary={"y_min": 0.1})
    start = replace(cube(height=0.07), v=torch.tensor([1.0, -1.0, 0.0]))
    if name == "constants":
        files = {"identified": identified(tmp_path / "identified.json", contact_friction=record)}
    else:
        law = structured_law({**SPEC, "form": "stretch"}, DT, seed=0)
        files = {"adaptor": str(tmp_path / "a.safetensors")}
        about = {"stable": True, "contact_friction": record}
        save_adaptor(files["adaptor"], trained(law), 2, 4.0, about)
    x = {}
    for elsewhere in (False, True):
        model = loaded(name, files, {"elsewhere": True} if elsewhere else {})
        path, failure = model.predict(mpm, start, (0, 40))
        used = mpm if elsewhere else mpm.with_friction(friction)
        expected = rollout(used, model.law, start, steps=40, frames=(0, 40))
        assert failure is None and torch.equal(path.x, expected.x)
        x[elsewhere] = path.x[-1]
    assert (x[False] - x[True]).abs().max() > 1e-3


@pytest.mark.parametrize(
    ("record", "friction"), [(None, 0.1), ({"value": 0.4}, 0.4), ({"at_least": 0.8}, math.inf)]
)
def test_a_correction_is_trained_with_the_identified_friction(record, friction, tmp_path, monkeypatch):
    class Reached(Exception):
        pass

    def train(mpm, *args, **options):
        assert set(mpm.frictions) == {friction}
        raise Reached

    body = ball(dtype=torch.float32)
    seen = observe(body, (0.0, -2.0, 0.0), (0, 8, 16, 60, 64))
    monkeypatch.setattr("neuma_lib.fitting.structured_fit.train_structured", train)
    for part, stub in (("load_reconstruction", body), ("with_motion", body.state((0.0, -2.0, 0.0)))):
        monkeypatch.setattr(f"neuma_lib.methods.training.{part}", lambda *files, stub=stub: stub)
    monkeypatch.setattr("neuma_lib.methods.training.load_videos", lambda *files, **exposure: [seen])
    inputs = dict.fromkeys(("particles", "binding", "gaussians", "velocity", "transforms"), "none")
    extra = {"contact_friction": record} if record else {}
    inputs["identified"] = identified(tmp_path / "identified.json", **extra)
    problem = Problem({"dt": 2e-3, "grid": 16, "contact": "particles", "boundary": 0.1}, [1000.0], {})
    run = SimpleNamespace(device=torch.device("cpu"), checkpoint=lambda *known: None, progress=None, log=None)
    with pytest.raises(Reached):
        Structured().fit(inputs, {"base": None, **StructuredOptions().plain()}, problem, run)


def test_the_true_law_needs_no_file():
    model = loaded("true_law", {}, {"law": STIFF})
    assert torch.equal(bent(model.law), bent(analytic_law(STIFF)))


def test_pac_nerf_has_the_law_that_it_fitted(tmp_path):
    write_json(tmp_path / "constants.json", {"law": STIFF})
    model = loaded("pac_nerf.method", {"constants": str(tmp_path / "constants.json")})
    assert torch.equal(bent(model.law), bent(analytic_law(STIFF)))


def test_paths_are_checked_before_they_are_read(tmp_path):
    path = identified(tmp_path / "identified.json")
    source = ModelSource("neuma_lib.methods.constants", {}, {"identified": "identified.json"}, DT)
    asked = []
    source.load(lambda file: asked.append(file) or path)
    assert asked == ["identified.json"] == source.paths


# ---- several bodies


def test_models_together_move_as_consecutive_bodies():
    """Two cubes that meet: one model of both gives the motion of the simulator, bit for bit."""
    mpm, below, above = MPM(grid=16, dt=DT), cube(height=0.1), cube(height=0.22)
    both = State(
        *(torch.cat([getattr(s, name) for s in (below, above)]) for name in ("x", "v", "mass", "vol0"))
    )
    laws, counts = [analytic_law(SPEC, DT), analytic_law(STIFF, DT)], [len(below.x), len(above.x)]
    each = [LawOnGrid(law, stable=k > 0, friction=0.3) for k, law in enumerate(laws)]
    model = LawOnGrid.together(each, counts)  # with the friction of the simulation
    frames = (0, 30, 60)
    path, failure = model.predict(mpm, both, frames)
    expected = rollout(mpm, consecutive(laws, counts), both, steps=60, frames=frames)
    assert failure is None and torch.equal(path.x, expected.x) and torch.equal(path.F, expected.F)
    alone = rollout(mpm, laws[0], both, steps=60, frames=frames)
    assert not torch.equal(path.x, alone.x) and not model.stable and model.law is laws[0]
    assert model.courant(mpm, both) == pytest.approx(max(mpm.courant(law, 1000.0) for law in laws))


def test_one_model_together_is_itself():
    model = LawOnGrid(analytic_law(SPEC))
    assert LawOnGrid.together([model], [7]) is model


# ---- draws


def draws(module, files, law=None, F=None, **uncertainty):
    method = method_of(f"neuma_lib.methods.{module}")
    uncertainty = {"model_std": 0.0, "spread": 1.0} | uncertainty
    return method.draws(files, law, F, uncertainty, dt=DT, count=200, seed=0)


def test_constants_are_drawn_from_their_covariance(tmp_path):
    laws = draws("constants", {"identified": identified(tmp_path / "identified.json")})
    moduli = np.log([law.elasticity.values["E"] for law in laws])
    stresses = np.log([law.plasticity.values["yield_stress"] for law in laws])
    assert len(laws) == 200
    # the mean of 200 draws is within four standard errors, and their spread within 20 %
    assert abs(moduli.mean() - 11.5) < 4 * 0.1 / 200**0.5 and moduli.std() == pytest.approx(0.1, rel=0.2)
    assert abs(stresses.mean() - 7.6) < 4 * 0.03**0.5 / 200**0.5
    wider = draws("constants", {"identified": identified(tmp_path / "identified.json")}, model_std=0.3)
    assert np.log([law.elasticity.values["E"] for law in wider]).std() == pytest.approx(0.316, rel=0.2)


def test_a_structured_law_is_drawn_around_itself_in_the_states_of_its_motion(tmp_path):
    law = structured_law({**SPEC, "form": "stretch"}, DT, seed=0)
    fit = {"identified": identified(tmp_path / "identified.json"), "rollout": str(tmp_path / "rollout.h5")}
    F = torch.eye(3) + 0.05 * torch.randn(2, 30, 3, 3, generator=torch.Generator().manual_seed(0))
    write_arrays(fit["rollout"], {"F": F.numpy()}, {})
    read, given = draws("structured", fit, law), draws("structured", fit, law, F)
    assert len(read) == 200 and torch.equal(bent(read[0]), bent(given[0]))
    assert draws("structured", {}, law) == []
    assert draws("structured", fit, structured_law({**STIFF, "form": "energy"}, DT)) == []


@pytest.mark.parametrize("module", ["neuma", "prior", "true_law", "spring_gaus.method", "pac_nerf.method"])
def test_other_methods_have_no_draws(module):
    assert draws(module, {}) == []


# ---- where methods come from

OWN = """
from neuma_lib.methods.base import Method, Preset


class Mine(Method):
    name = "mine"
    presets = {"mine_fast": Preset("Mine, fast")}

    def model_inputs(self, case):
        return {}

    def load(self, inputs, options, dt):
        raise NotImplementedError
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """An importable module with a method."""
    (tmp_path / "package_of_mine.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    registry.methods.cache_clear()
    yield "package_of_mine"
    registry.methods.cache_clear()
    sys.modules.pop("package_of_mine", None)


def test_installed_packages_add_methods_by_an_entry_point(package, monkeypatch):
    point = EntryPoint("mine", f"{package}:Mine", "neuma.methods")
    monkeypatch.setattr(registry, "entry_points", lambda group: [point] if group == point.group else [])
    assert [*registry.methods()][-1] == "mine" and method_of(package).name == "mine"
    presets = registry.built_in_presets()
    assert presets["mine_fast"]["kind"] == "mine" and presets["mine_fast"]["title"] == "Mine, fast"


def test_two_methods_of_one_name_are_refused(tmp_path):
    (tmp_path / "mine.py").write_text(OWN.replace('"mine"', '"neuma"'))
    with refused(tmp_path / "mine.py") as caught:
        registry.methods((str(tmp_path / "mine.py"),))
    assert "neuma_lib.methods.neuma" in caught.value.problem


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (None, "does not exist"),
        ("import no_such_package", "ModuleNotFoundError"),
        ("def", "SyntaxError"),
        (OWN + OWN.replace("Mine", "Other").replace('"mine', '"other'), "defines 2 methods"),
    ],
)
def test_files_that_cannot_be_used_are_refused(tmp_path, content, problem):
    file = tmp_path / "mine.py"
    if content is not None:
        file.write_text(content)
    with refused(file) as caught:
        registry.methods((str(file),))
    assert problem in caught.value.problem


def test_planning_loads_no_torch():
    code = """
import sys
from neuma_lib.project import cases, loading
settings = loading.load(loading.read_yaml("config/config.yaml"))
for name in settings.methods:
    case = cases.case(settings, "ClayCat", name)
    case.method.fit_inputs(case), case.source(), case.method.start_file(case)
print({"torch", "warp"} & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout == "set()\n", done.stderr
